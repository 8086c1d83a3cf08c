"""The data of glTF 2.0 files: containers, buffers and accessors."""

import base64
import binascii
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

from ._files import file_beside
from ._room import check_room

_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


class GltfData:
    """The JSON of a file, and what stands in its buffers. Everything is checked to lie within what the file holds.

    **Raises:** `ValueError` and, for entries that are missing or of a wrong type, the errors of indexing them.
    """

    def __init__(self, path: Path):
        self.path = path
        data = path.read_bytes()
        self.chunk: bytes | None = None
        if data[:4] == b"glTF":
            text, self.chunk = _chunks(data)
        elif path.suffix.lower() == ".glb":
            raise ValueError("it does not begin with `glTF`")
        else:
            text = data
        self.content: dict[str, Any] = json.loads(text)
        version = str(self.content["asset"]["version"])
        if not version.startswith("2."):
            raise ValueError(f"it is of version {version[:20]}, and version 2 is read")
        self._buffers: dict[int, bytes] = {}

    def entry(self, table: str, index: Any) -> dict[str, Any]:
        """Give an entry of one of the tables at the top."""
        entries = self.content.get(table, [])
        if isinstance(index, bool) or not isinstance(index, int) or not 0 <= index < len(entries):
            raise ValueError(f"it names entry {index!r} of its {len(entries)} {table}")
        return entries[index]

    def view(self, index: Any) -> memoryview:
        """Give the bytes of a buffer view."""
        entry = self.entry("bufferViews", index)
        start, length = _count(entry.get("byteOffset", 0)), _count(entry["byteLength"])
        buffer = self._buffer(entry["buffer"])
        if start + length > len(buffer):
            raise ValueError(f"its bufferViews promise {start + length} bytes of a buffer of {len(buffer)}")
        return memoryview(buffer)[start : start + length]

    def values(self, index: Any) -> np.ndarray:
        """Give the values of an accessor, [count, width]: what is normalized as floats, the rest as it stands in the file."""
        entry = self.entry("accessors", index)
        count, width = _count(entry["count"]), _WIDTHS[entry["type"]]
        kind = np.dtype(_COMPONENTS[entry["componentType"]])
        if "bufferView" in entry:
            found = self._rows(entry["bufferView"], entry.get("byteOffset", 0), count, width, kind, "accessors")
        elif "sparse" in entry:
            check_room(f"{self.path}: an accessor of {count} zeros", 80.0 * count * width, "write the file again")
            found = np.zeros((count, width), kind)
        else:
            raise ValueError("it has an accessor without data: export it without compression")
        if "sparse" in entry:
            found = self._with_sparse(found.copy(), entry["sparse"])
        if entry.get("normalized", False) and kind.kind in "iu":
            return np.maximum(found / np.iinfo(kind.str).max, -1.0)
        return found

    def _with_sparse(self, found: np.ndarray, sparse: dict[str, Any]) -> np.ndarray:
        count, indices, values = _count(sparse["count"]), sparse["indices"], sparse["values"]
        kind = np.dtype(_COMPONENTS[indices["componentType"]])
        places = self._rows(indices["bufferView"], indices.get("byteOffset", 0), count, 1, kind, "sparse accessors")[:, 0]
        if kind.kind != "u" or (places >= len(found)).any():
            raise ValueError("its sparse accessors name values that are not there")
        shape = found.shape[1], found.dtype
        found[places] = self._rows(values["bufferView"], values.get("byteOffset", 0), count, *shape, "sparse accessors")
        return found

    def _rows(self, view: Any, offset: Any, count: int, width: int, kind: np.dtype, what: str) -> np.ndarray:
        data, size = self.view(view), width * kind.itemsize
        stride, offset = _count(self.entry("bufferViews", view).get("byteStride", size)), _count(offset)
        if stride < size or (count and offset + (count - 1) * stride + size > len(data)):
            raise ValueError(f"its {what} promise {count} rows of {stride} bytes in a view of {len(data)}")
        return np.ndarray((count, width), kind, data, offset, (stride, kind.itemsize)) if count else np.zeros((0, width), kind)

    def _buffer(self, index: Any) -> bytes:
        entry = self.entry("buffers", index)
        if index not in self._buffers:
            if "uri" in entry:
                self._buffers[index] = self.named(entry["uri"])
            elif index == 0 and self.chunk is not None:
                self._buffers[index] = self.chunk
            else:
                raise ValueError(f"its buffer {index} is nowhere")
        return self._buffers[index]

    def named(self, uri: Any) -> bytes:
        """Give what a URI stands for: data written out within it, or a file beside."""
        if not isinstance(uri, str):
            raise ValueError(f"it has a URI {uri!r}")
        if not uri.startswith("data:"):
            return file_beside(self.path, uri, encoded=True).read_bytes()
        try:
            return base64.b64decode(uri.partition(";base64,")[2], validate=True)
        except binascii.Error as error:
            raise ValueError(f"data within it is not base64: {error}") from None


def _count(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise ValueError(f"it has {value!r} in the place of a count")
    return value


def _chunks(data: bytes) -> tuple[bytes, bytes | None]:
    """Give the JSON and the binary chunk of a GLB file."""
    if len(data) < 20:
        raise ValueError("it is cut short")
    version, length, text_length, kind = struct.unpack_from("<III4s", data, 4)
    if version != 2:
        raise ValueError(f"it is GLB of version {version}, and version 2 is read")
    if length > len(data) or 20 + text_length > length:
        raise ValueError(f"its header promises {max(length, 20 + text_length)} bytes, and it has {len(data)}: it is cut short")
    if kind != b"JSON":
        raise ValueError("its first chunk is not JSON")
    start = 20 + text_length
    text, chunk = data[20:start], None
    while start + 8 <= length:
        size, kind = struct.unpack_from("<I4s", data, start)
        if start + 8 + size > length:
            raise ValueError("its last chunk is cut short")
        if kind == b"BIN\0" and chunk is None:
            chunk = data[start + 8 : start + 8 + size]
        start += 8 + size
    return text, chunk
