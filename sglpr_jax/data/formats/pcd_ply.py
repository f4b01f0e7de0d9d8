"""Reads .pcd files of the Point Cloud Library and .ply files of Stanford: binary, compressed and text.

Both formats begin with a text header that lists the fields of a point. `parse_pcd` and `parse_ply` convert the header
to a `PointTable`; `table_scan` and `table_blocks` decode the points.
"""

import dataclasses
import itertools
import mmap
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from sglpr_jax.data.formats import clouds
from sglpr_jax.data.formats.clouds import check_points, cloud_scan
from sglpr_jax.data.formats.pose_files import parse_numbers, quaternion_poses
from sglpr_jax.data.scan import LASER_FIELDS, TIME_FIELDS, Scan
from sglpr_jax.files import in_short, warn
from sglpr_jax.se3 import transformed

Content = bytes | memoryview
AXES = ("x", "y", "z")
PADDING = "_"
"""Name of padding in .pcd files. The Point Cloud Library writes padding only with `DATA binary`."""
_NOT_A_NUMBER = re.compile(rb"[-+]?(?:nan\([^\s()]*\)|1\.#(?:ind|[qs]?nan)\w*)", re.IGNORECASE)
"""Spellings of NaN by the C libraries of Windows and Linux: `-nan(ind)`, `nan(0x1)`, `1.#QNAN`."""


class Field(NamedTuple):
    """Field of a point, such as x or intensity."""

    name: str
    number_type: str
    """Numpy type with byte order, or an empty string for padding."""
    width: int
    """Size of all values in bytes."""
    count: int = 1
    """Number of values per point, 0 for fields that some programs declare without values."""


class PointTable(NamedTuple):
    """Undecoded points of a file, and their fields by its header."""

    points: int
    """Number of points."""
    fields: list[Field]
    encoding: str
    """`binary` (one point after another), `binary_compressed` (one field after another) or `ascii`."""
    body: Content
    """Bytes from the first point on."""

    @property
    def layouts(self) -> tuple[list[Field], list[Field]]:
        """Fields without padding, and with padding. Text and compressed data may have either."""
        return [field for field in self.fields if field.name != PADDING], self.fields

    @property
    def row_bytes(self) -> int:
        """Size of a point in a binary file."""
        return sum(field.width for field in self.fields)


Parser = Callable[[Content], PointTable]


def table_scan(path: Path, *, parse: Parser) -> Scan:
    """Read the points of a scan in metres, and their times and lasers if the file has any. The axes are not changed."""
    table = parse(path.read_bytes())
    check_points(table.points, bytes_each=table.row_bytes)
    names = [field.name for field in table.fields if field.count == 1]
    wanted = [*AXES, *(name for name in (*TIME_FIELDS, *LASER_FIELDS) if names.count(name) == 1)]
    return cloud_scan(DECODERS[table.encoding](table, wanted))


def table_blocks(path: Path, *, parse: Parser) -> Iterator[Float64[np.ndarray, "_ 3"]]:
    """Yield the points of a map in metres, in blocks of `BLOCK_POINTS`. Only binary files are decoded in blocks."""
    with path.open("rb") as stream:  # mapped: a binary file may be larger than the memory
        table = parse(memoryview(mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)))
    if table.encoding != "binary":
        check_points(table.points, bytes_each=table.row_bytes)
    columns = DECODERS[table.encoding](table, AXES)
    for start in range(0, table.points, clouds.BLOCK_POINTS):
        rows = slice(start, start + clouds.BLOCK_POINTS)
        yield np.stack([columns[axis][rows].astype(np.float64) for axis in AXES], axis=1)


def _binary_records(table: PointTable, names: Sequence[str]) -> np.ndarray:
    """Return the points of a binary file as a structured array with the fields `names`."""
    starts = itertools.accumulate((field.width for field in table.fields), initial=0)
    columns = {field.name: (field.number_type, start) for field, start in zip(table.fields, starts, strict=False)}
    formats, offsets = zip(*(columns[name] for name in names), strict=True)
    record = np.dtype({"names": list(names), "formats": formats, "offsets": offsets, "itemsize": table.row_bytes})
    end = table.points * record.itemsize
    if len(table.body) < end or _has_data(table.body[end:]):
        raise ValueError(f"expected {table.points} points of {record.itemsize} bytes, found {len(table.body)} bytes")
    return np.frombuffer(table.body, record, table.points)


def _has_data(rest: Content) -> bool:
    """Whether the bytes after the points are more than blanks or zeros. Some programs fill the last page with zeros."""
    return bool(bytes(rest).strip(b"\0\r\n\t "))


def _compressed_columns(table: PointTable, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Decode the columns `names` of a compressed file: compressed size, decompressed size (uint32), and LZF data."""
    body, points = table.body, table.points
    if len(body) < 8:
        raise ValueError(f"expected two sizes before the points, found {len(body)} bytes")
    compressed_size, size = (int(number) for number in np.frombuffer(body, "<u4", count=2))
    end = 8 + compressed_size
    fields_by_size = {points * sum(field.width for field in fields): fields for fields in table.layouts}
    if size not in fields_by_size or len(body) < end or _has_data(body[end:]):
        expected = f"{max(fields_by_size)} bytes of {points} points in {compressed_size} bytes"
        raise ValueError(f"expected {expected}, found {size} in {len(body) - 8}")
    content = decompress_lzf(bytes(body[8:end]), size=size)
    columns, offset = {}, 0
    for field in fields_by_size[size]:
        if field.name in names:
            columns[field.name] = np.frombuffer(content, field.number_type, points, offset)
        offset += points * field.width
    return columns


def _text_columns(table: PointTable, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Decode the columns `names` of a text file with one line of numbers per point. NaN and infinity are accepted."""
    lines = _nonblank_lines(table.body)
    fields_by_width = {sum(field.count for field in fields): fields for fields in table.layouts}
    width = len(lines[0].split()) if lines else 0
    if width not in fields_by_width:
        width = max(fields_by_width)
    expected = f"expected {table.points} lines of {width} numbers"
    if len(lines) != table.points:
        raise ValueError(f"{expected}, found {len(lines)} lines")
    parsable = (_NOT_A_NUMBER.sub(b"nan", line).decode("ascii", errors="replace") for line in lines)
    try:
        rows = np.loadtxt(parsable, np.float64, comments=None, ndmin=2)
    except ValueError as error:
        raise ValueError(f"{expected}, found others ({in_short(error)})") from error
    if rows.shape[1] != width:
        raise ValueError(f"{expected}, found lines of {rows.shape[1]}")
    column_names = [field.name for field in fields_by_width[width] for _ in range(field.count)]
    return {name: rows[:, column_names.index(name)] for name in names}


DECODERS = {"binary": _binary_records, "binary_compressed": _compressed_columns, "ascii": _text_columns}
"""Functions that return columns of a table, by its encoding."""


def _nonblank_lines(body: Content) -> list[bytes]:
    return [line for line in bytes(body).splitlines() if line.strip()]


def decompress_lzf(data: bytes, *, size: int) -> bytes:
    """Decompress LZF data to `size` bytes.

    A control byte below 32 is followed by control + 1 literal bytes. Any other one stands for a copy of earlier output.
    Its upper 3 bits are the length - 2, where 7 adds the next byte. The other 5 bits and a byte are the distance - 1.
    """
    output, position = bytearray(), 0
    try:
        while position < len(data) and len(output) <= size:
            control = data[position]
            position += 1
            if control < 32:
                output += data[position : position + control + 1]
                position += control + 1
                continue
            length = (control >> 5) + 2
            if length == 9:
                length += data[position]
                position += 1
            start = len(output) - ((control & 31) << 8) - data[position] - 1
            position += 1
            if start < 0:
                raise ValueError("expected LZF, found a reference to before the start")
            run = output[start : start + length]
            if len(run) < length:  # the run overlaps the bytes that it appends, so it repeats itself
                run = (run * length)[:length]
            output += run
    except IndexError as error:
        raise ValueError("expected LZF, found truncated data") from error
    if len(output) != size or position != len(data):
        raise ValueError(f"expected {size} decompressed bytes, found {len(output)}")
    return bytes(output)


def _split_header(content: Content, last_line: bytes) -> tuple[list[str], Content]:
    """Return the lines of the header, up to the one that begins with `last_line`, and the bytes after it."""
    end = re.search(rb"^%b\b[^\n]*\n" % last_line, content, flags=re.MULTILINE)
    if end is None:
        raise ValueError(f"expected a header that ends with {last_line.decode()}, found none")
    header = bytes(content[: end.end()]).decode("ascii", errors="replace")
    return header.splitlines(), content[end.end() :]


def _whole_number(word: str, *, name: str) -> int:
    """Convert at most 18 decimal digits to a number. Raises ValueError, with the `name` of the number, otherwise."""
    if not re.fullmatch("[0-9]{1,18}", word):
        raise ValueError(f"expected a whole number as {name}, found {word[:40]!r}")
    return int(word)


def _check_axes(names: Sequence[str]) -> None:
    """Raise ValueError unless each of x, y and z occurs once in the names of fields."""
    if any(names.count(axis) != 1 for axis in AXES):
        raise ValueError(f"expected the fields x, y and z, found {' '.join(names) or 'none'}")


PCD_KEYWORDS = ("VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA")
"""First words of the lines of a header."""
IDENTITY = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
"""VIEWPOINT without movement and rotation: x, y, z, and a quaternion w, x, y, z."""
_LONGEST_HEADER = 65536
"""Number of bytes in which the header of a .pcd file is searched for its VIEWPOINT."""
PCD_REQUIRED = ("FIELDS", "SIZE", "TYPE", "POINTS", "DATA")
PCD_ENCODINGS = ("binary", "binary_compressed", "ascii")
PCD_TYPES = {
    ("F", "4"): "<f4",
    ("F", "8"): "<f8",
    **{(letter, str(size)): f"<{letter.lower()}{size}" for letter in "IU" for size in (1, 2, 4, 8)},
}
"""Numpy types by TYPE and SIZE."""


def parse_pcd(content: Content) -> PointTable:
    """Parse the header of a .pcd file. Raises ValueError for an unknown keyword, which may be a damaged known one."""
    lines, body = _split_header(content, b"DATA")
    header: dict[str, list[str]] = {}
    for line in lines:
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        if words[0] not in PCD_KEYWORDS or words[0] in header:
            raise ValueError(f"expected {', '.join(PCD_KEYWORDS)}, each once, in the header, found {line[:80]!r}")
        header[words[0]] = words[1:]
    missing = [keyword for keyword in PCD_REQUIRED if not header.get(keyword)]
    if missing:
        raise ValueError(f"expected a header with {', '.join(PCD_REQUIRED)}, found no {', '.join(missing)}")
    points = _whole_number(header["POINTS"][0], name="POINTS")
    width, height = (_whole_number((header.get(side) or ["1"])[0], name=side) for side in ("WIDTH", "HEIGHT"))
    if "WIDTH" in header and width * height != points:
        raise ValueError(f"expected POINTS of WIDTH x HEIGHT, {width} x {height}, found {points}")
    encoding = header["DATA"][0]
    if encoding not in PCD_ENCODINGS:
        raise ValueError(f"expected DATA {', '.join(PCD_ENCODINGS)}, found {encoding}")
    return PointTable(points, _pcd_fields(header), encoding, body)


def posed_scan(path: Path) -> Scan:
    """Read a .pcd file, and move its points from the frame of the sensor by the pose that it states (VIEWPOINT)."""
    scan, words = table_scan(path, parse=parse_pcd), _viewpoint(path)
    x, y, z, qw, *vector = parse_numbers(words, columns=7, where="VIEWPOINT") if words else IDENTITY
    (world_from_sensor,) = quaternion_poses(path, np.array([[x, y, z]]), np.array([[*vector, qw]]))
    points = transformed(world_from_sensor, scan.cloud.astype(np.float64))
    return dataclasses.replace(scan, points=points.astype(np.float32))


def warn_of_viewpoint(path: Path) -> None:
    """Warn if a .pcd file has a pose of the sensor (VIEWPOINT) other than the identity, which is not applied."""
    words = _viewpoint(path)
    if any(not _is_close(word, number) for word, number in zip(words, IDENTITY, strict=False)):
        found = f"its VIEWPOINT, {' '.join(words)}, is not applied (--format pcd-viewpoint applies it)"
        warn(f"{path}: the points are read as they are; {found}")


def _viewpoint(path: Path) -> list[str]:
    """Return the words of the VIEWPOINT of a .pcd file, or an empty list."""
    with path.open("rb") as stream:
        beginning = stream.read(_LONGEST_HEADER)
    viewpoint = re.search(rb"^VIEWPOINT +(.*)$", beginning.partition(b"\nDATA")[0], re.MULTILINE)
    return viewpoint[1].decode("ascii", errors="replace").split() if viewpoint else []


def _is_close(word: str, number: float) -> bool:
    """Whether a word is this number, up to rounding."""
    try:
        return abs(float(word) - number) < 1e-6
    except ValueError:
        return False


def _pcd_fields(header: dict[str, list[str]]) -> list[Field]:
    """Return the fields of a point by the words of each keyword in the header of a .pcd file."""
    names, sizes, types = header["FIELDS"], header["SIZE"], header["TYPE"]
    counts = header.get("COUNT", ["1"] * len(names))
    if not len(names) == len(sizes) == len(types) == len(counts):
        raise ValueError(f"expected one SIZE, TYPE and COUNT for each of {len(names)} FIELDS, found another number")
    _check_axes(names)
    fields = []
    for name, type_letter, size, count_word in zip(names, types, sizes, counts, strict=True):
        number_type = PCD_TYPES.get((type_letter.upper(), size), "")
        count = _whole_number(count_word, name="COUNT")
        type_needed = count > 0 and name != PADDING
        if (name in AXES and count != 1) or (type_needed and not number_type):
            raise ValueError(
                f"expected {name} of TYPE F, I or U and SIZE 1 to 8, and COUNT 1 for x, y and z, found TYPE"
                f" {type_letter.upper()}, SIZE {size} and COUNT {count_word}"
            )
        fields.append(Field(name, number_type, _whole_number(size, name="SIZE") * count, count))
    return fields


PLY_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2"},
    **{"int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8"},
}
PLY_BYTE_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


class _Element(NamedTuple):
    """Element of a .ply file: a table such as "vertex" or "face" with `count` rows."""

    name: str
    count: int
    properties: list[tuple[str, str]]
    """Name and type of each column. The type of a column of lists begins with "list "."""

    def fields(self, byte_order: str) -> list[Field]:
        """Return the fields of a row. Raises ValueError if a column has lists."""
        for name, ply_type in self.properties:
            if ply_type not in PLY_TYPES:
                raise ValueError(f"expected numbers for {name} of {self.name}, found {ply_type}")
        types = [(name, PLY_TYPES[ply_type]) for name, ply_type in self.properties]
        return [Field(name, byte_order + numpy_type, width=int(numpy_type[1])) for name, numpy_type in types]

    def size(self, *, binary: bool) -> int:
        """Return the size of all rows: bytes in a binary file, lines in a text file."""
        return self.count * sum(field.width for field in self.fields("")) if binary and self.count else self.count


def parse_ply(content: Content) -> PointTable:
    """Parse the header of a .ply file, and cut the vertices out of the body, which may contain other elements."""
    lines, body = _split_header(content, b"end_header")
    if lines[0].strip() != "ply":
        raise ValueError("expected a header from ply to end_header, found none")
    byte_order, elements = _ply_elements(lines[1:-1])
    names = [element.name for element in elements]
    if names.count("vertex") != 1:
        raise ValueError(f"expected an element vertex, found {' '.join(names) or 'none'}")
    vertex_row, binary = names.index("vertex"), bool(byte_order)
    vertices, later_elements = elements[vertex_row], elements[vertex_row + 1 :]
    fields = vertices.fields(byte_order)
    _check_axes([field.name for field in fields])
    start = sum(element.size(binary=binary) for element in elements[:vertex_row])
    end = start + vertices.size(binary=binary)
    text_lines = [] if binary else _nonblank_lines(body)
    later_types = [ply_type for element in later_elements for _, ply_type in element.properties]
    if not (binary and any(ply_type.startswith("list ") for ply_type in later_types)):  # lists have no known size
        declared = end + sum(element.size(binary=binary) for element in later_elements)
        found, unit = (len(body), "bytes") if binary else (len(text_lines), "lines")
        if found > declared:
            raise ValueError(f"expected at most {declared} {unit} after the header, found {found}")
    if binary:
        return PointTable(vertices.count, fields, "binary", body[start:end])
    return PointTable(vertices.count, fields, "ascii", b"\n".join(text_lines[start:end]))


def _ply_elements(lines: Sequence[str]) -> tuple[str, list[_Element]]:
    """Return the byte order ("<", ">", or "" for text) and the elements of the header of a .ply file."""
    formats, elements = [], []
    for line in lines:
        match line.split():
            case [] | ["comment" | "obj_info", *_]:
                pass
            case ["format", format, "1.0"]:
                formats.append(format)
            case ["element", name, count]:
                elements.append(_Element(name, _whole_number(count, name=f"number of {name}"), []))
            case ["property", "list", length_type, item_type, name] if elements:
                elements[-1].properties.append((name, f"list {length_type} {item_type}"))
            case ["property", number_type, *name_words] if elements and name_words:
                elements[-1].properties.append((" ".join(name_words), number_type))
            case _:  # perhaps a damaged property, without which the next fields would be shifted
                raise ValueError(f"expected format, element, property or comment in the header, found {line[:80]!r}")
    if len(formats) != 1 or formats[0] not in PLY_BYTE_ORDERS:
        expected, found = ", ".join(PLY_BYTE_ORDERS), " and ".join(formats)[:80] or "none"
        raise ValueError(f"expected format {expected}, found {found}")
    return PLY_BYTE_ORDERS[formats[0]], elements
