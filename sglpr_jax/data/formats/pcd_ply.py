"""Reads .pcd files of the Point Cloud Library and .ply files of Stanford: binary, compressed and text.

Both formats begin with a header in text, which lists the fields of a point. `parse_pcd` and `parse_ply` read it into a
`PointTable`, and the rest is the same.
"""

import mmap
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from sglpr_jax.data.formats import clouds
from sglpr_jax.data.formats.clouds import check_points, cloud_scan
from sglpr_jax.data.scan import Scan, time_field_of
from sglpr_jax.files import in_short

Content = bytes | memoryview
AXES = ("x", "y", "z")
PADDING = "_"
"""Name of padding in .pcd files. The Point Cloud Library writes padding only with `DATA binary`."""
_NOT_A_NUMBER = re.compile(rb"[-+]?(?:nan\([^\s()]*\)|1\.#(?:ind|[qs]?nan)\w*)", re.IGNORECASE)
"""Spellings of NaN by the C libraries of Windows and Linux: `-nan(ind)`, `nan(0x1)`, `1.#QNAN`."""


class Field(NamedTuple):
    """Field of a point."""

    name: str
    kind: str
    """Numpy type with byte order, or an empty string for padding."""
    width: int
    """Size of all values in bytes."""
    count: int = 1
    """Number of values. Some programs write fields without values."""


class PointTable(NamedTuple):
    """Points of a file, before they are decoded."""

    points: int
    """Number of points by the header."""
    fields: list[Field]
    encoding: str
    """`binary` (one point after another), `binary_compressed` (one field after another) or `ascii`."""
    body: Content
    """Bytes from the first point on."""

    @property
    def layouts(self) -> tuple[list[Field], list[Field]]:
        """Possible fields of a point in text and compressed data: without and with padding."""
        return [field for field in self.fields if field.name != PADDING], self.fields

    @property
    def row_bytes(self) -> int:
        """Size of a point in a binary file."""
        return sum(field.width for field in self.fields)


Parser = Callable[[Content], PointTable]


def table_scan(path: Path, *, parse: Parser) -> Scan:
    """Read the points of a scan in metres, and their times. The axes are not changed."""
    table = parse(path.read_bytes())
    check_points(table.points, bytes_each=table.row_bytes)
    names = [field.name for field in table.fields if field.count == 1]
    time = time_field_of([name for name in names if names.count(name) == 1])
    decode = {"binary": _binary_records, "binary_compressed": _compressed_columns, "ascii": _text_columns}
    columns = decode[table.encoding](table, AXES if time is None else (*AXES, time))
    return cloud_scan(columns, time=time)


def table_blocks(path: Path, *, parse: Parser) -> Iterator[Float64[np.ndarray, "_ 3"]]:
    """Yield the points of a map in metres, in parts. A binary file may be larger than the memory."""
    with path.open("rb") as stream:
        table = parse(memoryview(mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)))
    if table.encoding != "binary":
        yield table_scan(path, parse=parse).cloud.astype(np.float64)
        return
    records = _binary_records(table, AXES)
    for start in range(0, len(records), clouds.BLOCK_POINTS):
        block = records[start : start + clouds.BLOCK_POINTS]
        yield np.stack([block[axis].astype(np.float64) for axis in AXES], axis=1)


def _binary_records(table: PointTable, names: Sequence[str]) -> np.ndarray:
    starts = np.cumsum([0, *(field.width for field in table.fields)]).tolist()
    by_name = {field.name: (field.kind, start) for field, start in zip(table.fields, starts, strict=False)}
    formats, offsets = zip(*(by_name[name] for name in names), strict=True)
    row = np.dtype({"names": list(names), "formats": formats, "offsets": offsets, "itemsize": table.row_bytes})
    end = table.points * row.itemsize
    if len(table.body) < end or _holds_more(table.body[end:]):
        raise ValueError(f"expected {table.points} points of {row.itemsize} bytes, found {len(table.body)} bytes")
    return np.frombuffer(table.body, row, table.points)


def _holds_more(rest: Content) -> bool:
    """Whether there is data after the points. Some programs fill the last page with zeros."""
    return bool(bytes(rest).strip(b"\0\r\n\t "))


def _compressed_columns(table: PointTable, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Decode two sizes and LZF data."""
    body, points = table.body, table.points
    if len(body) < 8:
        raise ValueError(f"expected two sizes before the points, found {len(body)} bytes")
    packed, size = (int(number) for number in np.frombuffer(body, "<u4", count=2))
    layouts = {points * sum(field.width for field in fields): fields for fields in table.layouts}
    end = 8 + packed
    if size not in layouts or len(body) < end or _holds_more(body[end:]):
        raise ValueError(
            f"expected {max(layouts)} bytes of {points} points in {packed} bytes, found {size} in {len(body) - 8}"
        )
    content, columns, start = decompress_lzf(bytes(body[8:end]), size=size), {}, 0
    for field in layouts[size]:
        if field.name in names:
            columns[field.name] = np.frombuffer(content, field.kind, points, start)
        start += points * field.width
    return columns


def _text_columns(table: PointTable, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Decode one line of numbers for each point. NaN and infinity are numbers."""
    lines = _lines(table.body)
    layouts = {sum(field.count for field in fields): fields for fields in table.layouts}
    width = len(lines[0].split()) if lines else 0
    width = width if width in layouts else max(layouts)
    expected = f"expected {table.points} lines of {width} numbers"
    if len(lines) != table.points:
        raise ValueError(f"{expected}, found {len(lines)} lines")
    words = (_NOT_A_NUMBER.sub(b"nan", line).decode("ascii", errors="replace") for line in lines)
    try:
        rows = np.loadtxt(words, np.float64, comments=None, ndmin=2)
    except ValueError as error:
        raise ValueError(f"{expected}, found others ({in_short(error)})") from error
    if rows.shape[1] != width:
        raise ValueError(f"{expected}, found lines of {rows.shape[1]}")
    order = [field.name for field in layouts[width] for _ in range(field.count)]
    return {name: rows[:, order.index(name)] for name in names}


def _lines(body: Content) -> list[bytes]:
    """Lines that are not blank."""
    return [line for line in bytes(body).splitlines() if line.strip()]


def decompress_lzf(data: bytes, *, size: int) -> bytes:
    """Decompress LZF data, which consists of literal runs and back references, to `size` bytes."""
    out, at, end = bytearray(), 0, len(data)
    try:
        while at < end and len(out) <= size:
            control = data[at]
            at += 1
            if control < 32:  # a literal run of control + 1 bytes
                out += data[at : at + control + 1]
                at += control + 1
                continue
            length = control >> 5
            if length == 7:
                length += data[at]
                at += 1
            start = len(out) - ((control & 31) << 8) - data[at] - 1
            at += 1
            if start < 0:
                raise ValueError("expected LZF, found a reference to before the start")
            run = out[start : start + length + 2]  # the reference may overlap the bytes that it appends
            out += (run * (length + 2))[: length + 2] if len(run) < length + 2 else run
    except IndexError as error:
        raise ValueError("expected LZF, found truncated data") from error
    if len(out) != size or at != end:
        raise ValueError(f"expected {size} decompressed bytes, found {len(out)}")
    return bytes(out)


def _split(content: Content, last_line: bytes) -> tuple[list[str], Content]:
    """Return the lines of the header, up to the one that begins with `last_line`, and the bytes after it."""
    end = re.search(rb"^%b\b[^\n]*\n" % last_line, content, flags=re.MULTILINE)
    if end is None:
        raise ValueError(f"expected a header that ends with {last_line.decode()}, found none")
    header = bytes(content[: end.end()]).decode("ascii", errors="replace")
    return header.splitlines(), content[end.end() :]


def _whole_number(word: str, *, of: str) -> int:
    """Return a number of at most 18 decimal digits. Raises ValueError for other words. The message names `of`."""
    if not re.fullmatch("[0-9]{1,18}", word):
        raise ValueError(f"expected a whole number as {of}, found {word[:40]!r}")
    return int(word)


def _check_axes(names: Sequence[str]) -> None:
    if any(names.count(axis) != 1 for axis in AXES):
        raise ValueError(f"expected the fields x, y and z, found {' '.join(names) or 'none'}")


PCD_KEYWORDS = ("VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA")
"""First words of the lines of a header."""
PCD_NEEDED = ("FIELDS", "SIZE", "TYPE", "POINTS", "DATA")
PCD_ENCODINGS = ("binary", "binary_compressed", "ascii")
PCD_KINDS = {
    ("F", "4"): "<f4",
    ("F", "8"): "<f8",
    **{(kind, str(size)): f"<{kind.lower()}{size}" for kind in "IU" for size in (1, 2, 4, 8)},
}
"""Numpy types by TYPE and SIZE."""


def parse_pcd(content: Content) -> PointTable:
    """Parse the header of a .pcd file. An unknown keyword is an error: it may be a damaged one."""
    lines, body = _split(content, b"DATA")
    words: dict[str, list[str]] = {}
    for line in lines:
        keyword, *values = line.split() or ["#"]
        if keyword.startswith("#"):
            continue
        if keyword not in PCD_KEYWORDS or keyword in words:
            raise ValueError(f"expected {', '.join(PCD_KEYWORDS)}, each once, in the header, found {line[:80]!r}")
        words[keyword] = values
    missing = [keyword for keyword in PCD_NEEDED if not words.get(keyword)]
    if missing:
        raise ValueError(f"expected a header with {', '.join(PCD_NEEDED)}, found no {', '.join(missing)}")
    points = _whole_number(words["POINTS"][0], of="POINTS")
    width, height = (_whole_number((words.get(side) or ["1"])[0], of=side) for side in ("WIDTH", "HEIGHT"))
    if "WIDTH" in words and width * height != points:
        raise ValueError(f"expected POINTS of WIDTH x HEIGHT, {width} x {height}, found {points}")
    if words["DATA"][0] not in PCD_ENCODINGS:
        raise ValueError(f"expected DATA {', '.join(PCD_ENCODINGS)}, found {words['DATA'][0]}")
    return PointTable(points, _pcd_fields(words), words["DATA"][0], body)


def _pcd_fields(words: dict[str, list[str]]) -> list[Field]:
    names, sizes, kinds = (words[keyword] for keyword in ("FIELDS", "SIZE", "TYPE"))
    counts = words.get("COUNT", ["1"] * len(names))
    if not len(names) == len(sizes) == len(kinds) == len(counts):
        raise ValueError(f"expected one SIZE, TYPE and COUNT for each of {len(names)} FIELDS, found another number")
    _check_axes(names)
    fields = []
    for name, kind, size, count in zip(names, kinds, sizes, counts, strict=True):
        number, values = PCD_KINDS.get((kind.upper(), size), ""), _whole_number(count, of="COUNT")
        if (name in AXES and values != 1) or not (number or name == PADDING or not values):
            raise ValueError(
                f"expected {name} of TYPE F, I or U and SIZE 1 to 8, and COUNT 1 for x, y and z, found TYPE"
                f" {kind.upper()}, SIZE {size} and COUNT {count}"
            )
        fields.append(Field(name, number, _whole_number(size, of="SIZE") * values, values))
    return fields


PLY_KINDS = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2"},
    **{"int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8"},
}
PLY_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


class _Element(NamedTuple):
    """Element of a .ply file."""

    name: str
    count: int
    """Number of instances in the file."""
    properties: list[tuple[str, str]]
    """Name and type of each property. The type of a list begins with "list"."""

    def fields(self, order: str) -> list[Field]:
        """Return the fields of an instance. Raises ValueError if one is a list."""
        wrong = next(((name, kind) for name, kind in self.properties if kind not in PLY_KINDS), None)
        if wrong is not None:
            raise ValueError(f"expected numbers for {wrong[0]} of {self.name}, found {wrong[1]}")
        kinds = [(name, PLY_KINDS[kind]) for name, kind in self.properties]
        return [Field(name, order + kind, int(kind[1])) for name, kind in kinds]

    def size(self, *, binary: bool) -> int:
        """Number of bytes, or of lines in a text file, of all instances."""
        return self.count * (sum(field.width for field in self.fields("")) if binary and self.count else 1)


def parse_ply(content: Content) -> PointTable:
    """Parse the header of a .ply file, and find the vertices between the other elements."""
    lines, body = _split(content, b"end_header")
    if lines[0].strip() != "ply":
        raise ValueError("expected a header from ply to end_header, found none")
    order, elements = _ply_elements(lines[1:-1])
    names = [element.name for element in elements]
    if names.count("vertex") != 1:
        raise ValueError(f"expected an element vertex, found {' '.join(names) or 'none'}")
    at, binary = names.index("vertex"), bool(order)
    vertices, behind = elements[at], elements[at + 1 :]
    fields = vertices.fields(order)
    _check_axes([field.name for field in fields])
    start = sum(element.size(binary=binary) for element in elements[:at])
    end = start + vertices.size(binary=binary)
    text = [] if binary else _lines(body)
    if not (binary and any(kind.startswith("list ") for element in behind for _, kind in element.properties)):
        most = end + sum(element.size(binary=binary) for element in behind)  # not known for lists of numbers
        found, unit = (len(body), "bytes") if binary else (len(text), "lines")
        if found > most:
            raise ValueError(f"expected at most {most} {unit} after the header, found {found}")
    if binary:
        return PointTable(vertices.count, fields, "binary", body[start:end])
    return PointTable(vertices.count, fields, "ascii", b"\n".join(text[start:end]))


def _ply_elements(lines: Sequence[str]) -> tuple[str, list[_Element]]:
    """Return byte order, empty for text, and elements of a header.

    An unknown line is an error: it may be a damaged property, which would shift the others.
    """
    orders, elements = [], []
    for line in lines:
        match line.split():
            case [] | ["comment" | "obj_info", *_]:
                pass
            case ["format", order, "1.0"]:
                orders.append(order)
            case ["element", name, count]:
                elements.append(_Element(name, _whole_number(count, of=f"number of {name}"), []))
            case ["property", "list", length, item, name] if elements:
                elements[-1].properties.append((name, f"list {length} {item}"))
            case ["property", kind, *name] if elements and name:
                elements[-1].properties.append((" ".join(name), kind))
            case _:
                raise ValueError(f"expected format, element, property or comment in the header, found {line[:80]!r}")
    if len(orders) != 1 or orders[0] not in PLY_ORDERS:
        raise ValueError(f"expected format {', '.join(PLY_ORDERS)}, found {' and '.join(orders)[:80] or 'none'}")
    return PLY_ORDERS[orders[0]], elements
