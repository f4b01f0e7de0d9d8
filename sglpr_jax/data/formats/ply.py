"""Reads the vertices of .ply files (Stanford format), in text or in binary of either byte order."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32

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
    properties: list[tuple[str, str | None]]
    """Name and type of each property. The type of a list of variable length is `None`."""


def read_ply(path: Path) -> Float32[np.ndarray, "n 3"]:
    """Return the vertices (n, 3) of a .ply file, NaN included. The axes are not changed.

    Raises:
      FileNotFoundError: If the file does not exist.
      ValueError: If the header, the properties or the number of points are invalid.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a .ply file, found none")
    try:
        return _decode(path.read_bytes())
    except (ValueError, IndexError, KeyError) as error:
        raise ValueError(f"{path}: expected a readable .ply file, found an invalid one: {error}") from error


def _decode(content: bytes) -> Float32[np.ndarray, "n 3"]:
    header, mark, body = content.partition(b"end_header")
    lines = header.decode("ascii", errors="replace").splitlines()
    if not mark or lines[0].strip() != "ply":
        raise ValueError("expected a header from `ply` to `end_header`, found none")
    body = body.partition(b"\n")[2]
    order, elements = _parse_header(lines[1:])
    before, vertices = _until_vertices(elements)
    names = [name for name, _ in vertices.properties]
    if not {"x", "y", "z"} <= set(names):
        raise ValueError(f"expected vertices with x, y and z, found {' '.join(names) or 'none'}")
    if vertices.count < 1:
        raise ValueError("expected at least one vertex, found none")
    if order == "ascii":
        return _read_text(body, vertices, skipped=sum(element.count for element in before))
    skipped = sum(element.count * _record(element, order).itemsize for element in before)
    return _read_binary(body[skipped:], vertices, _record(vertices, order))


def _parse_header(lines: list[str]) -> tuple[str, list[_Element]]:
    order, elements = "", []
    for line in lines:
        match line.split():
            case ["format", found, *_]:
                order = found
            case ["element", name, count]:
                elements.append(_Element(name, int(count), []))
            case ["property", "list", _, _, name]:
                elements[-1].properties.append((name, None))
            case ["property", kind, name]:
                elements[-1].properties.append((name, kind))
    if order not in _ORDERS:
        raise ValueError(f"expected format {', '.join(_ORDERS)}, found {order or 'none'}")
    return order, elements


def _until_vertices(elements: list[_Element]) -> tuple[list[_Element], _Element]:
    """Elements before the vertices, and the vertices."""
    names = [element.name for element in elements]
    if "vertex" not in names:
        raise ValueError(f"expected an element vertex, found {' '.join(names) or 'none'}")
    return elements[: names.index("vertex")], elements[names.index("vertex")]


def _record(element: _Element, order: str) -> np.dtype:
    kinds = []
    for name, kind in element.properties:
        if kind not in _TYPES:
            raise ValueError(f"expected numbers for {name} of {element.name}, found {kind or 'a list'}")
        kinds.append((name, _ORDERS[order] + _TYPES[kind]))
    return np.dtype(kinds)


def _read_binary(body: bytes, vertices: _Element, record: np.dtype) -> Float32[np.ndarray, "n 3"]:
    if len(body) < vertices.count * record.itemsize:
        raise ValueError(f"expected {vertices.count} points of {record.itemsize} bytes, found {len(body)} bytes")
    records = np.frombuffer(body, record, count=vertices.count)
    with np.errstate(over="ignore", invalid="ignore"):
        return np.stack([records[axis] for axis in "xyz"], axis=1).astype(np.float32)


def _read_text(body: bytes, vertices: _Element, *, skipped: int) -> Float32[np.ndarray, "n 3"]:
    lines = [line for line in body.decode("ascii", errors="replace").splitlines() if line.strip()]
    rows = [line.split() for line in lines[skipped : skipped + vertices.count]]
    width = len(vertices.properties)
    if len(rows) != vertices.count or any(len(row) != width for row in rows):
        raise ValueError(f"expected {vertices.count} lines of {width} numbers, found {len(rows)} lines or others")
    columns = [[name for name, _ in vertices.properties].index(axis) for axis in "xyz"]
    return np.array([[row[column] for column in columns] for row in rows], dtype=np.float32)
