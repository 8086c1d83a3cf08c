"""Tables of PLY files: ASCII or binary of either byte order, scalars and lists, of any type and in
any order.
"""

import re
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import numpy as np
import plyfile

from ._library import readable

_LONGEST_HEADER = 1 << 20
_END = re.compile(rb"(\r\n|\r|\n)end_header\1")
_ELEMENT = re.compile(r"element\s+(\S+)\s+(\d{1,18})\Z")
_USUAL = {
    "texcoord": 6
}  # numbers in a list, for which a table is read at once; in others, those of triangles


class Ragged(NamedTuple):
    """Lists of a column: how long each is, and all their values one after the other."""

    counts: np.ndarray
    values: np.ndarray


class PlyFile(NamedTuple):
    """Comments, and the columns of each element: arrays, or lists of several lengths."""

    comments: list[str]
    elements: dict[str, dict[str, np.ndarray | Ragged]]

    def rows(self, element: str) -> int:
        """Count the rows of an element: none of one that is not there, and of one that is announced
        without any.
        """
        columns = self.elements.get(element, {}).values()
        return max(
            (len(column.counts if isinstance(column, Ragged) else column) for column in columns),
            default=0,
        )


def read_ply(path: Path) -> PlyFile:
    """Read all tables of a PLY file with plyfile, after a look at whether it can hold what its
    header says.

    **Raises:** `ValueError` when the file is no PLY, is cut short, or holds more than its header
    says.
    """
    data = path.read_bytes()
    with readable(path, "PLY"):
        end = _END.search(data, 0, _LONGEST_HEADER)
        if data[:3] != b"ply" or end is None:
            raise ValueError("it does not begin with `ply`, or its header has no end")
        text, body = data[: end.end()].decode("utf-8", "replace"), memoryview(data)[end.end() :]
        lines = text.split(end[1].decode())
        plain = text.encode("ascii", "replace")  # which plyfile asks of comments, too
        counts = _check_counts(lines, plain, body)
        source = str(path) if text.isascii() else BytesIO(plain + body)
        found = _read(source, counts)
        _check_end(found, body)
        comments = [line.strip()[len("comment ") :] for line in lines if line.startswith("comment")]
        return PlyFile(comments, {element.name: _columns(element) for element in found})


def _check_counts(rows: list[str], header: bytes, body: memoryview) -> dict[str, dict[str, int]]:
    """Refuse a header that promises more than follows it; give how long the lists of each element
    usually are.
    """
    counted = [_ELEMENT.match(row.strip()) for row in rows if row.startswith("element")]
    if None in counted:
        raise ValueError("its header has an element without a count")
    empty = plyfile.PlyData.read(BytesIO(re.sub(rb"(element\s+\S+\s+)\d+", rb"\g<1>0", header)))
    least = -1 if empty.text else 0
    for element, count in zip(empty, counted, strict=True):
        sizes = [
            2 if empty.text else np.dtype(getattr(p, "len_dtype", p.val_dtype)).itemsize
            for p in element.properties
        ]
        if not sizes and count is not None and int(count[2]):
            raise ValueError(f"its element {element.name!r} has no property")
        if any(np.dtype(getattr(p, "len_dtype", "u1")).kind == "f" for p in element.properties):
            raise ValueError(
                f"its element {element.name!r} has lists whose lengths are no whole numbers"
            )
        least += 0 if count is None else int(count[2]) * sum(sizes)
    if least > len(body):
        raise ValueError(
            f"its header promises {least} bytes at least, and {len(body)} follow it: it is cut "
            "short"
        )
    lists = plyfile.PlyListProperty
    return {
        e.name: {p.name: _USUAL.get(p.name, 3) for p in e.properties if isinstance(p, lists)}
        for e in empty
    }


def _read(source: str | BytesIO, usual: dict[str, dict[str, int]]) -> plyfile.PlyData:
    """Read at once what has lists of the usual lengths only, otherwise row by row."""
    if isinstance(source, str) and any(usual.values()):
        try:
            return plyfile.PlyData.read(source, known_list_len=usual)
        except plyfile.PlyElementParseError:
            pass
    return plyfile.PlyData.read(source)


def _check_end(found: plyfile.PlyData, body: memoryview) -> None:
    """Refuse what holds more than its header says."""
    if found.text:
        if b"_" in bytes(body):  # which Python takes for a part of numbers
            raise ValueError("it has `_` among its numbers")
        rows = sum(1 for line in bytes(body).decode("ascii").splitlines() if line.strip())
        if rows != sum(element.count for element in found):
            raise ValueError(
                f"its header promises {sum(element.count for element in found)} rows, and {rows} "
                "follow it"
            )
        return
    taken = 0
    for element in found:
        for p in element.properties:
            size = np.dtype(p.val_dtype).itemsize
            if isinstance(p, plyfile.PlyListProperty):
                taken += element.count * np.dtype(p.len_dtype).itemsize + size * sum(
                    map(len, element[p.name])
                )
            else:
                taken += size * element.count
    if taken < len(body) and bytes(body[taken : taken + 16]).strip():
        raise ValueError(f"{len(body) - taken} bytes follow what its header promises")


def _columns(element: plyfile.PlyElement) -> dict[str, np.ndarray | Ragged]:
    columns: dict[str, np.ndarray | Ragged] = {}
    for p in element.properties:
        column = np.asarray(element[p.name])
        if not isinstance(p, plyfile.PlyListProperty):
            columns[p.name] = column
        elif column.ndim == 2:
            columns[p.name] = Ragged(np.full(len(column), column.shape[1]), column.reshape(-1))
        else:
            values = np.concatenate([np.zeros(0, p.val_dtype), *column])
            columns[p.name] = Ragged(np.fromiter(map(len, column), np.int64, len(column)), values)
    return columns
