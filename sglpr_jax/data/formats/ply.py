"""Reads the vertices of .ply files (Stanford format), in text or in binary of either byte order."""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from sglpr_jax.data.formats.clouds import (
    blocks_of,
    check_points,
    cloud_scan,
    mapped,
    number_rows,
    packed_type,
    text_lines,
    whole_number,
)
from sglpr_jax.data.scan import Scan, time_field_of

_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2"},
    **{"int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8"},
}
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


class _Element(NamedTuple):
    """Element of a .ply file."""

    name: str
    count: int
    """Number of instances in the file."""
    properties: list[tuple[str, str]]
    """Name and type of each property. The type of a list begins with "list"."""

    def fields(self, order: str) -> list[tuple[str, str, int]]:
        """Name, numpy type and size of each property. Raises ValueError if one is not a number."""
        wrong = next((name for name, kind in self.properties if kind not in _TYPES), None)
        if wrong is not None:
            raise ValueError(f"expected numbers for {wrong} of {self.name}, found {dict(self.properties)[wrong]}")
        return [(name, f"{order}{_TYPES[kind]}", int(_TYPES[kind][1])) for name, kind in self.properties]

    @property
    def bytes(self) -> int:
        """Size of all instances in a binary file."""
        return self.count * sum(size for _, _, size in self.fields("<")) if self.count else 0


class _Header(NamedTuple):
    order: str
    """Byte order, or an empty string for text."""
    before: list[_Element]
    vertices: _Element
    behind: list[_Element]


def ply_scan(path: Path) -> Scan:
    """Decode the vertices of a file."""
    header, body = _split(path.read_bytes())
    properties = [name for name, _ in header.vertices.properties]
    time = time_field_of([name for name in properties if properties.count(name) == 1])
    check_points(header.vertices.count, bytes_each=sum(size for _, _, size in header.vertices.fields("<")))
    if header.order:
        return cloud_scan(_binary_records(header, body, ("x", "y", "z", *([time] if time else []))), time=time)
    first, count = sum(element.count for element in header.before), header.vertices.count
    lines = text_lines(bytes(body))  # one for each instance of an element
    _check_end(len(lines), first + count + sum(element.count for element in header.behind), unit="lines")
    rows = number_rows(lines[first : first + count], rows=count, columns=len(properties))
    return cloud_scan({name: rows[:, properties.index(name)] for name in properties}, time=time)


def ply_blocks(path: Path) -> Iterator[Float64[np.ndarray, "_ 3"]]:
    """Yield the vertices in parts. The file may have any size if it is binary."""
    header, body = _split(mapped(path))
    if header.order:
        yield from blocks_of(_binary_records(header, body, "xyz"))
    else:
        yield ply_scan(path).cloud.astype(np.float64)


def _split(content: bytes | memoryview) -> tuple[_Header, bytes | memoryview]:
    """Header, and the bytes after it."""
    end = re.search(rb"^end_header[ \t\r]*\n", content, flags=re.MULTILINE)  # not a comment that contains the word
    lines = bytes(content[: end.start()]).decode("ascii", errors="replace").splitlines() if end else []
    if end is None or not lines or lines[0].strip() != "ply":
        raise ValueError("expected a header from `ply` to `end_header`, found none")
    return _parse_header(lines[1:]), content[end.end() :]


def _parse_header(lines: Sequence[str]) -> _Header:
    """Parse a header. An unknown line is an error: it may be a damaged property, which would shift the others."""
    orders, elements = [], []
    for line in lines:
        match line.split():
            case [] | ["comment" | "obj_info", *_]:
                pass
            case ["format", found, "1.0"]:
                orders.append(found)
            case ["element", name, count]:
                elements.append(_Element(name, whole_number(count, of=f"number of {name}"), []))
            case ["property", "list", length, item, name] if elements:
                elements[-1].properties.append((name, f"list {length} {item}"))
            case ["property", kind, *name] if elements and name:
                elements[-1].properties.append((" ".join(name), kind))
            case _:
                raise ValueError(f"expected format, element, property or comment in the header, found {line[:80]!r}")
    if len(orders) != 1 or orders[0] not in _ORDERS:
        raise ValueError(f"expected format {', '.join(_ORDERS)}, found {' and '.join(orders)[:80] or 'none'}")
    names = [element.name for element in elements]
    if names.count("vertex") != 1:
        raise ValueError(f"expected an element vertex, found {' '.join(names) or 'none'}")
    at = names.index("vertex")
    axes = [name for name, _ in elements[at].properties]
    if any(axes.count(axis) != 1 for axis in "xyz"):
        raise ValueError(f"expected vertices with x, y and z, found {' '.join(axes) or 'none'}")
    return _Header(_ORDERS[orders[0]], elements[:at], elements[at], elements[at + 1 :])


def _binary_records(header: _Header, body: bytes | memoryview, names: Sequence[str]) -> np.ndarray:
    row = packed_type(header.vertices.fields(header.order), names)
    body = body[sum(element.bytes for element in header.before) :]
    if len(body) < header.vertices.bytes:
        raise ValueError(f"expected {header.vertices.count} points of {row.itemsize} bytes, found {len(body)} bytes")
    lists = [kind for element in header.behind for _, kind in element.properties if kind.startswith("list ")]
    if not lists:  # their size is not known
        _check_end(len(body), header.vertices.bytes + sum(element.bytes for element in header.behind), unit="bytes")
    return np.frombuffer(body, row, count=header.vertices.count)


def _check_end(found: int, most: int, *, unit: str) -> None:
    """Raise ValueError if a file is longer than its header declares: the header may be damaged."""
    if found > most:
        raise ValueError(f"expected at most {most} {unit} after the header, found {found}")
