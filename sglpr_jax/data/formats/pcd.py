"""Reads .pcd files of the Point Cloud Library: binary, compressed and text."""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from sglpr_jax.data.formats.clouds import (
    Records,
    blocks_of,
    check_points,
    mapped_content,
    number_rows,
    packed_type,
    read_content,
    records_of,
    text_lines,
    time_field_of,
    whole_number,
)

_NUMBERS = {(kind, str(size)): f"<{kind.lower()}{size}" for kind in "IU" for size in (1, 2, 4, 8)}
_NUMBERS |= {("F", "4"): "<f4", ("F", "8"): "<f8"}
"""Numpy types by TYPE and SIZE."""
KEYWORDS = ("VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS")
"""First words of the lines of a header, before that of DATA."""
AXES = ("x", "y", "z")


class _Field(NamedTuple):
    """Field of a point. Padding has the name `_`, and some programs write fields without values (`count` 0)."""

    name: str
    kind: str
    """Numpy type, or an empty string for padding."""
    size: int
    """Size of a number in bytes."""
    count: int
    """Number of values in a point."""

    @property
    def width(self) -> int:
        """Size of the field in bytes."""
        return self.size * self.count


class _Header(NamedTuple):
    points: int
    fields: tuple[_Field, ...]
    encoding: str
    """Word after DATA."""

    @property
    def unpadded(self) -> tuple[_Field, ...]:
        """Fields without padding. The Point Cloud Library writes padding only with `DATA binary`."""
        return tuple(field for field in self.fields if field.name != "_")


def pcd_records(path: Path) -> Records:
    """Return the points and times of a .pcd file with `DATA binary`, `binary_compressed` or `ascii`, NaN included.

    Raises:
      FileNotFoundError: If the file does not exist.
      ValueError: If the header, the fields or the number of points are invalid.
    """
    try:
        return _decode(read_content(path))
    except ValueError as error:
        raise ValueError(f"{path}: expected a readable .pcd file, found an invalid one: {error}") from error


def pcd_blocks(path: Path) -> Iterator[Float64[np.ndarray, "_ 3"]]:
    """Yield the points of a .pcd file in parts. The file may have any size if it has `DATA binary`.

    Raises ValueError if the file is invalid, or has another encoding and exceeds the size of a scan.
    """
    try:
        content = mapped_content(path)
        header, body = _split(content)
        if header.encoding == "binary":
            yield from blocks_of(_binary_records(header, body, AXES))
        else:
            yield _decode(content).points.astype(np.float64)
    except ValueError as error:
        raise ValueError(f"{path}: expected a .pcd file of a map, preferably DATA binary, found {error}") from error


def _split(content: bytes | memoryview) -> tuple[_Header, bytes | memoryview]:
    """Header, and the bytes after it."""
    data = re.search(rb"^DATA[ \t]+(\w+)[^\n]*\n", content, flags=re.MULTILINE)
    if data is None:
        raise ValueError("expected a header that ends with a DATA line, found none")
    words = _keywords(bytes(content[: data.start()]).decode("ascii", errors="replace"))
    points = whole_number(words["POINTS"][0], of="POINTS")
    sides = [whole_number((words.get(side) or ["1"])[0], of=side) for side in ("WIDTH", "HEIGHT")]
    if "WIDTH" in words and sides[0] * sides[1] != points:
        raise ValueError(f"expected POINTS of WIDTH x HEIGHT, {sides[0]} x {sides[1]}, found {points}")
    return _Header(points, _fields(words), data[1].decode(errors="replace")), content[data.end() :]


def _keywords(text: str) -> dict[str, list[str]]:
    """Words after each keyword of a header. An unknown keyword is an error: it may be a damaged one."""
    words: dict[str, list[str]] = {}
    for line in text.splitlines():
        keyword, *values = line.split() or ["#"]
        if keyword.startswith("#"):
            continue
        if keyword not in KEYWORDS or keyword in words:
            raise ValueError(f"expected {', '.join(KEYWORDS)}, each once, in the header, found {line[:80]!r}")
        words[keyword] = values
    missing = [keyword for keyword in ("FIELDS", "SIZE", "TYPE", "POINTS") if not words.get(keyword)]
    if missing:
        raise ValueError(f"expected a header with FIELDS, SIZE, TYPE and POINTS, found no {', '.join(missing)}")
    return words


def _fields(words: dict[str, list[str]]) -> tuple[_Field, ...]:
    names, sizes, kinds = (words[keyword] for keyword in ("FIELDS", "SIZE", "TYPE"))
    counts = words.get("COUNT", ["1"] * len(names))
    if not len(names) == len(sizes) == len(kinds) == len(counts):
        raise ValueError(f"expected one SIZE, TYPE and COUNT for each of {len(names)} FIELDS, found another number")
    if any(names.count(axis) != 1 for axis in AXES):
        raise ValueError(f"expected the fields x, y and z, found {' '.join(names)}")
    return tuple(map(_field, names, kinds, sizes, counts))


def _field(name: str, kind: str, size: str, count: str) -> _Field:
    number = _NUMBERS.get((kind.upper(), size), "")
    field = _Field(name, number, whole_number(size, of="SIZE"), whole_number(count, of="COUNT"))
    ignored = name == "_" or not field.count
    if (name in AXES and field.count != 1) or not (ignored or number):
        raise ValueError(
            f"expected {name} of TYPE F, I or U and SIZE 1 to 8, and COUNT 1 for x, y and z, found TYPE"
            f" {kind.upper()}, SIZE {size} and COUNT {count}"
        )
    return field


def _decode(content: bytes | memoryview) -> Records:
    header, body = _split(content)
    decode = {"binary": _binary_records, "binary_compressed": _compressed_columns, "ascii": _text_columns}
    if header.encoding not in decode:
        raise ValueError(f"expected DATA {', '.join(decode)}, found {header.encoding}")
    check_points(header.points, bytes_each=sum(field.width for field in header.fields))
    time = time_field_of([field.name for field in header.fields if field.count == 1])
    names = (*AXES, *([] if time is None else [time]))
    columns = decode[header.encoding](header, body, names)
    return records_of([columns[name] for name in names], time)


def _binary_records(header: _Header, body: bytes | memoryview, names: Sequence[str]) -> np.ndarray:
    record = packed_type([(field.name, field.kind, field.width) for field in header.fields], names)
    end = header.points * record.itemsize
    if len(body) < end or bytes(body[end:]).strip(b"\0\r\n\t "):  # some programs fill the last page with zeros
        raise ValueError(f"expected {header.points} points of {record.itemsize} bytes, found {len(body)} bytes")
    return np.frombuffer(body, record, header.points)


def _compressed_columns(header: _Header, body: bytes | memoryview, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Decode two sizes and LZF data, which contains one field after another: all x, all y and so on."""
    if len(body) < 8:
        raise ValueError(f"expected two sizes before the points, found {len(body)} bytes")
    packed, size = (int(number) for number in np.frombuffer(body, "<u4", count=2))
    points = header.points
    layouts = {points * sum(field.width for field in fields): fields for fields in (header.unpadded, header.fields)}
    end = 8 + packed
    if size not in layouts or len(body) < end or bytes(body[end:]).strip(b"\0\r\n\t "):
        raise ValueError(
            f"expected {max(layouts)} bytes of {points} points in {packed} bytes, found {size} in {len(body) - 8}"
        )
    content = decompress_lzf(bytes(body[8:end]), size=size)
    found, start = {}, 0
    for field in layouts[size]:
        if field.name in names:
            found[field.name] = np.frombuffer(content, field.kind, points, start)
        start += points * field.width
    return found


def _text_columns(header: _Header, body: bytes | memoryview, names: Sequence[str]) -> dict[str, np.ndarray]:
    lines = text_lines(bytes(body))
    layouts = {sum(field.count for field in fields): fields for fields in (header.unpadded, header.fields)}
    columns = len(lines[0].split()) if lines else 0
    columns = columns if columns in layouts else max(layouts)
    rows = number_rows(lines, rows=header.points, columns=columns)
    order = [field.name for field in layouts[columns] for _ in range(field.count)]
    return {name: rows[:, order.index(name)] for name in names}


def decompress_lzf(data: bytes, *, size: int) -> bytes:
    """Decompress LZF data, which consists of literal runs and back references.

    Raises:
      ValueError: If `data` is truncated, malformed or does not have `size` bytes when decompressed.
    """
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
