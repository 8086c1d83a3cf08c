"""Tables of PLY files: ASCII or binary of either byte order, scalars and lists, of any type and in any order."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

_TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4", "double": "f8"}
_TYPES |= {"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"}
_TYPES |= {"float32": "f4", "float64": "f8"}
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_LONGEST_HEADER = 1 << 20


class Ragged(NamedTuple):
    """Lists of a column: how long each is, and all their values one after the other."""

    counts: np.ndarray
    values: np.ndarray


class Property(NamedTuple):
    """A column: its name, the type of its values and, of lists, that of their lengths."""

    name: str
    kind: np.dtype
    lengths: np.dtype | None


class Element(NamedTuple):
    """A table: its name, its rows and its columns."""

    name: str
    count: int
    properties: list[Property]

    def least_bytes(self, text: bool) -> int:
        """Give how many bytes its rows take at least: in text a digit and what separates it from the next."""
        each = [2 if text else (p.kind if p.lengths is None else p.lengths).itemsize for p in self.properties]
        return self.count * sum(each)


class PlyFile(NamedTuple):
    """Comments, and the columns of each element: arrays, or lists of several lengths."""

    comments: list[str]
    elements: dict[str, dict[str, np.ndarray | Ragged]]


def read_ply(path: Path) -> PlyFile:
    """Read all tables of a PLY file. No more memory is taken than a few times the size of the file, whatever its header says.

    **Raises:** `ValueError` when the file is no PLY, is cut short, or holds more than its header says.
    """
    data = path.read_bytes()
    try:
        order, comments, elements, start = _header(data)
        body = memoryview(data)[start:]
        text = order == "="
        least = sum(element.least_bytes(text) for element in elements) - text
        if least > len(body):
            raise ValueError(f"its header promises {least} bytes at least, and {len(body)} follow it: it is cut short")
        tables = _text_tables(elements, bytes(body).decode("latin-1")) if text else _binary_tables(elements, body, order)
    except ValueError as error:
        raise ValueError(f"{path}: cannot be read as PLY: {error}; write it again") from None
    return PlyFile(comments, tables)


def _header(data: bytes) -> tuple[str, list[str], list[Element], int]:
    if data[:3] != b"ply" or data[3:4] not in (b"\n", b"\r"):
        raise ValueError("it does not begin with `ply`")
    newline = b"\r\n" if data[3:5] == b"\r\n" else data[3:4]
    end = data.find(newline + b"end_header" + newline, 0, _LONGEST_HEADER)
    if end < 0:
        raise ValueError("its header has no end")
    order, comments, elements = "", [], []
    for line in data[3:end].split(newline):
        match line.decode("latin-1").split():
            case [] | ["obj_info", *_]:
                pass
            case ["comment", *_]:
                comments.append(line.decode("utf-8", "replace").strip()[len("comment ") :])
            case ["format", kind, "1.0"] if kind in _ORDERS and not order:
                order = _ORDERS[kind]
            case ["element", name, count] if count.isdecimal() and len(count) < 19 and order:
                if any(element.name == name for element in elements):
                    raise ValueError(f"it has two elements {name!r}")
                elements.append(Element(name, int(count), []))
            case ["property", *what] if elements:
                elements[-1].properties.append(_property(what, order, elements[-1]))
            case _:
                raise ValueError(f"its header has a line {line.decode('latin-1')[:60]!r}, which is no line of PLY 1.0")
    if not order:
        raise ValueError("its header says no format")
    for element in elements:
        if element.count and not element.properties:
            raise ValueError(f"its element {element.name!r} has no property")
    return order, comments, elements, end + len(newline + b"end_header" + newline)


def _property(what: list[str], order: str, element: Element) -> Property:
    match what:
        case ["list", lengths, kind, name] if kind in _TYPES and _TYPES.get(lengths, "f4")[0] in "iu":
            found = Property(name, np.dtype(order + _TYPES[kind]), np.dtype(order + _TYPES[lengths]))
        case [kind, name] if kind in _TYPES:
            found = Property(name, np.dtype(order + _TYPES[kind]), None)
        case _:
            raise ValueError(f"its header has a property {' '.join(what)[:60]!r}, of no type that PLY has")
    if any(other.name == found.name for other in element.properties):
        raise ValueError(f"its element {element.name!r} has two properties {found.name!r}")
    return found


def _binary_tables(elements: list[Element], body: memoryview, order: str) -> dict[str, dict[str, np.ndarray | Ragged]]:
    tables, start = {}, 0
    for element in elements:
        tables[element.name], start = _binary_table(element, body, start)
    if bytes(body[start : start + 16]).strip():
        raise ValueError(f"{len(body) - start} bytes follow what its header promises")
    return tables


def _binary_table(element: Element, body: memoryview, start: int) -> tuple[dict[str, np.ndarray | Ragged], int]:
    lists = [p for p in element.properties if p.lengths is not None]
    if element.count == 0:
        return {p.name: _column(p, np.zeros(0, np.int64), np.zeros(0, p.kind)) for p in element.properties}, start
    # Lists of one length, as those of triangles are, are columns like any other.
    first, _ = _walk(element._replace(count=1), body, start)
    fields, sizes = [], {}
    for i, (p, (_, counts)) in enumerate(zip(element.properties, first, strict=True)):
        if p.lengths is not None:
            sizes[p.name] = int(counts[0])
            fields.append((f"{i} length", p.lengths))
        fields.append((f"{i}", p.kind, (sizes[p.name],)) if p.lengths is not None else (f"{i}", p.kind))
    row = np.dtype(fields)
    if row.itemsize * element.count <= len(body) - start:
        rows: np.ndarray = np.frombuffer(body, row, element.count, start)
        lengths = {i: rows[f"{i} length"] for i, p in enumerate(element.properties) if p.lengths is not None}
        if all((lengths[i] == sizes[p.name]).all() for i, p in enumerate(element.properties) if p.lengths is not None):
            columns = {p.name: _column(p, lengths.get(i), rows[f"{i}"]) for i, p in enumerate(element.properties)}
            return columns, start + row.itemsize * element.count
    if not lists:
        raise ValueError(f"its element {element.name!r} is cut short")
    places, end = _walk(element, body, start)
    return {p.name: _gathered(p, body, *place) for p, place in zip(element.properties, places, strict=True)}, end


def _column(p: Property, lengths: np.ndarray | None, values: np.ndarray) -> np.ndarray | Ragged:
    return values if p.lengths is None else Ragged(np.asarray(lengths, np.int64), values.reshape(-1))


def _walk(element: Element, body: memoryview, start: int) -> tuple[list[tuple[np.ndarray, np.ndarray]], int]:
    """Give, for each column, where its values begin in every row and how many they are; and where the element ends."""
    places: list[list[int]] = [[] for _ in element.properties]
    counts: list[list[int]] = [[] for _ in element.properties]
    signs = [p.lengths is not None and p.lengths.kind == "i" for p in element.properties]
    order = "big" if any(p.kind.str[0] == ">" or (p.lengths or p.kind).str[0] == ">" for p in element.properties) else "little"
    for number in range(element.count):
        for i, p in enumerate(element.properties):
            count = 1
            if p.lengths is not None:
                count = int.from_bytes(body[start : start + p.lengths.itemsize], order, signed=signs[i])
                start += p.lengths.itemsize
            places[i].append(start)
            counts[i].append(count)
            start += count * p.kind.itemsize
            if count < 0 or start > len(body):
                raise ValueError(f"its element {element.name!r} is cut short at row {number}")
    return [
        (np.asarray(place, np.int64), np.asarray(count, np.int64)) for place, count in zip(places, counts, strict=True)
    ], start


def _gathered(p: Property, body: memoryview, places: np.ndarray, counts: np.ndarray) -> np.ndarray | Ragged:
    size = p.kind.itemsize
    begins = np.repeat(places - size * (np.cumsum(counts) - counts), counts) + size * np.arange(counts.sum())
    values = np.frombuffer(body, np.uint8)[begins[:, None] + np.arange(size)].view(p.kind)[:, 0]
    return values if p.lengths is None else Ragged(counts, values)


def _text_tables(elements: list[Element], body: str) -> dict[str, dict[str, np.ndarray | Ragged]]:
    lines = [line for line in body.splitlines() if line and not line.isspace()]
    promised = sum(element.count for element in elements)
    if len(lines) != promised:
        raise ValueError(f"its header promises {promised} rows, and {len(lines)} follow it: it is cut short, or not what it says")
    tables, start = {}, 0
    for element in elements:
        rows = lines[start : start + element.count]
        tables[element.name] = _text_table(element, rows)
        start += element.count
    return tables


def _text_table(element: Element, lines: list[str]) -> dict[str, np.ndarray | Ragged]:
    alone = len(element.properties) == 1 and element.properties[0].lengths is not None
    if all(p.lengths is None for p in element.properties) or (alone and len({line.count(" ") for line in lines}) == 1):
        numbers = _numbers(element, lines)
        if not alone:
            if numbers.shape[1] != len(element.properties):
                raise ValueError(f"rows of its element {element.name!r} have {numbers.shape[1]} numbers")
            return {p.name: _typed(p, numbers[:, i], p.kind) for i, p in enumerate(element.properties)}
        if (numbers[:, 0] == numbers.shape[1] - 1).all():
            p = element.properties[0]
            counts = np.full(len(lines), numbers.shape[1] - 1)
            return {p.name: Ragged(counts, _typed(p, numbers[:, 1:].reshape(-1), p.kind))}
    counts: list[list[int]] = [[] for _ in element.properties]
    values: list[list[str]] = [[] for _ in element.properties]
    for number, line in enumerate(lines):
        words, at = line.split(), 0
        for i, p in enumerate(element.properties):
            count = 1
            if p.lengths is not None:
                length = words[at] if at < len(words) else ""
                if not length.isdecimal() or len(length) > 9:
                    raise ValueError(f"row {number} of its element {element.name!r} has a list of length {length!r}")
                count, at = int(length), at + 1
            counts[i].append(count)
            values[i].extend(words[at : at + count])
            at += count
        if at != len(words):
            raise ValueError(f"row {number} of its element {element.name!r} has {len(words)} numbers instead of {at}")
    columns = {}
    for p, lengths, found in zip(element.properties, counts, values, strict=True):
        numbers = _typed(p, _numbers(element, found)[:, 0] if found else np.zeros(0), p.kind)
        columns[p.name] = numbers if p.lengths is None else Ragged(np.asarray(lengths, np.int64), numbers)
    return columns


def _numbers(element: Element, lines: list[str]) -> np.ndarray:
    if not lines:
        return np.zeros((0, len(element.properties)))
    try:
        return np.loadtxt(lines, np.float64, comments=None, ndmin=2)
    except ValueError as error:
        raise ValueError(f"its element {element.name!r}: {error}") from None


def _typed(p: Property, numbers: np.ndarray, kind: np.dtype) -> np.ndarray:
    if kind.kind == "f":
        with np.errstate(over="ignore"):
            return numbers.astype(kind)
    low, high = np.iinfo(kind).min, np.iinfo(kind).max
    if len(numbers) and not ((numbers >= low) & (numbers <= high) & (numbers == np.floor(numbers))).all():
        raise ValueError(f"{p.name} has values that its type, from {low} to {high}, does not hold")
    return numbers.astype(kind)
