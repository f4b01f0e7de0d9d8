"""Reads the vertices of .ply files (Stanford format), in text or in binary of either byte order."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import accumulate
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64

from sglpr_jax.data.formats.bin_records import Records
from sglpr_jax.data.formats.cloud_text import (
    blocks_of,
    check_points,
    mapped_content,
    number_rows,
    read_content,
    text_lines,
    whole_number,
)
from sglpr_jax.data.point_times import TimeField, time_field_of

_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2"},
    **{"int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8"},
}
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass
class _Element:
    """Element of a .ply file."""

    name: str
    count: int
    """Number of instances in the file."""
    properties: list[tuple[str, str]] = field(default_factory=list)
    """Name and type of each property. The type of a list is "list", the type of its length, and that of its items."""

    @property
    def sizes(self) -> list[int]:
        """Size of each property in bytes. Raises ValueError if a property is not a number."""
        wrong = next((name for name, kind in self.properties if kind not in _TYPES), None)
        if wrong is not None:
            found = dict(self.properties)[wrong]
            raise ValueError(f"expected numbers for {wrong} of {self.name}, found {found}")
        return [_size(kind) for _, kind in self.properties]

    @property
    def is_list(self) -> bool:
        """Whether the size of an instance varies."""
        return any(kind.startswith("list ") for _, kind in self.properties)

    @property
    def bytes(self) -> int:
        """Size of all instances in a binary file."""
        return self.count * sum(self.sizes) if self.count else 0


def read_ply(path: Path) -> Float32[np.ndarray, "n 3"]:
    """Return the vertices (n, 3) of a .ply file. Raises what `ply_records` raises."""
    return ply_records(path).points


def ply_records(path: Path) -> Records:
    """Return the vertices of a .ply file and their times, NaN included. The axes are not changed.

    Raises:
      FileNotFoundError: If the file does not exist.
      ValueError: If the header, the properties or the number of points are invalid.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a .ply file, found none")
    try:
        return _decode(read_content(path))
    except ValueError as error:
        raise ValueError(f"{path}: expected a readable .ply file, found an invalid one: {error}") from error


def ply_blocks(path: Path) -> Iterator[Float64[np.ndarray, "_ 3"]]:
    """Yield the vertices of a .ply file in parts. The file may have any size if it is binary.

    Raises:
      FileNotFoundError: If the file does not exist.
      ValueError: If the file is invalid, or is in text and exceeds the size of a scan.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a .ply file, found none")
    try:
        content = mapped_content(path)
        order, elements, body = _split(content)
        if order == "ascii":
            yield _decode(content).points.astype(np.float64)
            return
        points = _binary_records(body, elements, _ORDERS[order], "xyz")
        yield from blocks_of(points, "xyz")
    except ValueError as error:
        raise ValueError(f"{path}: expected a .ply file of a map, preferably binary, found {error}") from error


def _split(content: bytes | memoryview) -> tuple[str, list[_Element], bytes | memoryview]:
    """Format and elements of the header, and the bytes after it."""
    end = re.search(rb"^end_header[ \t\r]*\n", content, flags=re.MULTILINE)  # not a comment that contains the word
    lines = bytes(content[: end.start()]).decode("ascii", errors="replace").splitlines() if end else []
    if end is None or not lines or lines[0].strip() != "ply":
        raise ValueError("expected a header from `ply` to `end_header`, found none")
    return *_parse_header(lines[1:]), content[end.end() :]


def _decode(content: bytes | memoryview) -> Records:
    order, elements, body = _split(content)
    at = _index_of_vertices(elements)
    properties = [name for name, _ in elements[at].properties]
    time = time_field_of([name for name in properties if properties.count(name) == 1])
    names = (*"xyz", *([] if time is None else [time]))
    columns = _columns(elements[at], names)
    check_points(elements[at].count, bytes_each=sum(elements[at].sizes))
    if order == "ascii":
        found = list(_read_text(bytes(body), elements[:at], elements[at], elements[at + 1 :])[:, columns].T)
    else:
        records = _binary_records(body, elements, _ORDERS[order], names)
        found = [records[name] for name in names]
    with np.errstate(over="ignore", invalid="ignore"):
        points = np.stack(found[:3], axis=1).astype(np.float32)
    return Records(points, None, None if time is None else TimeField(time, found[3].copy()))


def _parse_header(lines: Sequence[str]) -> tuple[str, list[_Element]]:
    """Format and elements. An unknown line is an error: it may be a damaged property, which would shift the others."""
    orders, elements = [], []
    for line in lines:
        match line.split():
            case [] | ["comment" | "obj_info", *_]:
                pass
            case ["format", found, "1.0"]:
                orders.append(found)
            case ["element", name, count]:
                elements.append(_Element(name, whole_number(count, of=f"number of {name}")))
            case ["property", "list", length, item, name] if elements:
                elements[-1].properties.append((name, f"list {length} {item}"))
            case ["property", kind, *name] if elements and name:
                elements[-1].properties.append((" ".join(name), kind))
            case _:
                raise ValueError(f"expected format, element, property or comment in the header, found {line[:80]!r}")
    if len(orders) != 1 or orders[0] not in _ORDERS:
        raise ValueError(f"expected format {', '.join(_ORDERS)}, found {' and '.join(orders)[:80] or 'none'}")
    return orders[0], elements


def _index_of_vertices(elements: Sequence[_Element]) -> int:
    names = [element.name for element in elements]
    if names.count("vertex") != 1:
        raise ValueError(f"expected an element vertex, found {' '.join(names) or 'none'}")
    return names.index("vertex")


def _columns(vertices: _Element, wanted: Sequence[str]) -> list[int]:
    """Columns of the wanted properties, x, y and z among them. Other properties may appear twice."""
    names = [name for name, _ in vertices.properties]
    if any(names.count(axis) != 1 for axis in "xyz"):
        raise ValueError(f"expected vertices with x, y and z, found {' '.join(names) or 'none'}")
    return [names.index(name) for name in wanted]


def _binary_records(
    body: bytes | memoryview, elements: Sequence[_Element], order: str, names: Sequence[str]
) -> np.ndarray:
    """Records of the vertices with the named properties."""
    at = _index_of_vertices(elements)
    vertices, columns = elements[at], _columns(elements[at], names)
    body = body[sum(element.bytes for element in elements[:at]) :]
    offsets = list(accumulate(vertices.sizes, initial=0))
    kinds = [order + _TYPES[kind] for _, kind in vertices.properties]
    record = np.dtype(
        {
            "names": list(names),
            "formats": [kinds[column] for column in columns],
            "offsets": [offsets[column] for column in columns],
            "itemsize": offsets[-1],
        }
    )
    if len(body) < vertices.bytes:
        raise ValueError(f"expected {vertices.count} points of {record.itemsize} bytes, found {len(body)} bytes")
    end = vertices.bytes
    for element in elements[at + 1 :]:
        end = _end_of_lists(body, end, element, order) if element.is_list else end + element.bytes
    _check_end(len(body), end, unit="bytes")
    return np.frombuffer(body, record, count=vertices.count)


def _end_of_lists(body: bytes | memoryview, at: int, element: _Element, order: str) -> int:
    """Position behind all instances of an element with lists, which starts at `at`. It may be behind the file."""
    steps = [_step(kind, name) for name, kind in element.properties]
    for _ in range(element.count):
        for length_size, item_size, signed in steps:
            length = 1
            if length_size:
                words = body[at : at + length_size]
                length = int.from_bytes(words, "big" if order == ">" else "little", signed=signed)
            if length < 0:
                raise ValueError(f"expected lists of 0 or more items in {element.name}, found {length}")
            at += length_size + length * item_size
        if at >= len(body):  # the rest of the lists is missing: the vertices are whole
            break
    return at


def _step(kind: str, name: str) -> tuple[int, int, bool]:
    """Size of the length of a list (0 for a number), size of an item, and whether the length is signed."""
    if not kind.startswith("list "):
        return 0, _size(kind), False
    _, length, item = kind.split(" ")
    if _TYPES.get(length, "f")[0] not in "iu" or item not in _TYPES:
        raise ValueError(f"expected a list of numbers for {name}, found {kind}")
    return _size(length), _size(item), _TYPES[length][0] == "i"


def _size(kind: str) -> int:
    """Size of a number in bytes."""
    return np.dtype(_TYPES[kind]).itemsize


def _read_text(
    body: bytes, before: Sequence[_Element], vertices: _Element, behind: Sequence[_Element]
) -> Float64[np.ndarray, "n columns"]:
    """All properties of the vertices. Each instance of an element is a line."""
    skipped = sum(element.count for element in before)
    lines = text_lines(body)
    _check_end(len(lines), skipped + vertices.count + sum(element.count for element in behind), unit="lines")
    return number_rows(lines[skipped : skipped + vertices.count], rows=vertices.count, columns=len(vertices.properties))


def _check_end(found: int, most: int, *, unit: str) -> None:
    """Raise ValueError if a file is longer than its header declares: the header may be damaged."""
    if found > most:
        raise ValueError(f"expected at most {most} {unit} after the header, found {found}")
