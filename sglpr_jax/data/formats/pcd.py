"""Reads .pcd files of the Point Cloud Library: binary, compressed and text."""

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

_NUMBERS = {(kind, str(size)): f"<{kind.lower()}{size}" for kind in "IU" for size in (1, 2, 4, 8)}
_NUMBERS |= {("F", "4"): "<f4", ("F", "8"): "<f8"}
"""Numpy types by TYPE and SIZE."""
KEYWORDS = ("VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS")
"""First words of the lines of a header, before that of DATA."""
PADDING = "_"
"""Name of padding. The Point Cloud Library writes padding only with `DATA binary`."""
AXES = ("x", "y", "z")


class _Field(NamedTuple):
    """Field of a point. Some programs write fields without values (`count` 0)."""

    name: str
    kind: str
    """Numpy type, or an empty string for padding."""
    width: int
    """Size of all values in bytes."""
    count: int
    """Number of values in a point."""


class _Header(NamedTuple):
    points: int
    fields: list[_Field]
    encoding: str
    """Word after DATA."""

    @property
    def layouts(self) -> tuple[list[_Field], list[_Field]]:
        """Possible fields of a point in text and compressed data: without and with padding."""
        return [field for field in self.fields if field.name != PADDING], self.fields


def pcd_scan(path: Path) -> Scan:
    """Decode a file with `DATA binary`, `binary_compressed` or `ascii`."""
    header, body = _split(path.read_bytes())
    decode = {"binary": _binary_records, "binary_compressed": _compressed_columns, "ascii": _text_columns}
    if header.encoding not in decode:
        raise ValueError(f"expected DATA {', '.join(decode)}, found {header.encoding}")
    check_points(header.points, bytes_each=sum(field.width for field in header.fields))
    time = time_field_of([field.name for field in header.fields if field.count == 1])
    names = AXES if time is None else (*AXES, time)
    return cloud_scan(decode[header.encoding](header, body, names), time=time)


def pcd_blocks(path: Path) -> Iterator[Float64[np.ndarray, "_ 3"]]:
    """Yield the points in parts. The file may have any size if it has `DATA binary`."""
    header, body = _split(mapped(path))
    if header.encoding == "binary":
        yield from blocks_of(_binary_records(header, body, AXES))
    else:
        yield pcd_scan(path).cloud.astype(np.float64)


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


def _fields(words: dict[str, list[str]]) -> list[_Field]:
    names, sizes, kinds = (words[keyword] for keyword in ("FIELDS", "SIZE", "TYPE"))
    counts = words.get("COUNT", ["1"] * len(names))
    if not len(names) == len(sizes) == len(kinds) == len(counts):
        raise ValueError(f"expected one SIZE, TYPE and COUNT for each of {len(names)} FIELDS, found another number")
    if any(names.count(axis) != 1 for axis in AXES):
        raise ValueError(f"expected the fields x, y and z, found {' '.join(names)}")
    found = []
    for name, kind, size, count in zip(names, kinds, sizes, counts, strict=True):
        width, number = whole_number(size, of="SIZE"), _NUMBERS.get((kind.upper(), size), "")
        values = whole_number(count, of="COUNT")
        if (name in AXES and values != 1) or not (number or name == PADDING or not values):
            raise ValueError(
                f"expected {name} of TYPE F, I or U and SIZE 1 to 8, and COUNT 1 for x, y and z, found TYPE"
                f" {kind.upper()}, SIZE {size} and COUNT {count}"
            )
        found.append(_Field(name, number, width * values, values))
    return found


def _binary_records(header: _Header, body: bytes | memoryview, names: Sequence[str]) -> np.ndarray:
    row = packed_type([(field.name, field.kind, field.width) for field in header.fields], names)
    end = header.points * row.itemsize
    if len(body) < end or _holds_more(body[end:]):
        raise ValueError(f"expected {header.points} points of {row.itemsize} bytes, found {len(body)} bytes")
    return np.frombuffer(body, row, header.points)


def _holds_more(rest: bytes | memoryview) -> bool:
    """Whether there is data after the points. Some programs fill the last page with zeros."""
    return bool(bytes(rest).strip(b"\0\r\n\t "))


def _compressed_columns(header: _Header, body: bytes | memoryview, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Decode two sizes and LZF data, which contains one field after another: all x, all y and so on."""
    if len(body) < 8:
        raise ValueError(f"expected two sizes before the points, found {len(body)} bytes")
    packed, size = (int(number) for number in np.frombuffer(body, "<u4", count=2))
    points = header.points
    layouts = {points * sum(field.width for field in fields): fields for fields in header.layouts}
    end = 8 + packed
    if size not in layouts or len(body) < end or _holds_more(body[end:]):
        raise ValueError(
            f"expected {max(layouts)} bytes of {points} points in {packed} bytes, found {size} in {len(body) - 8}"
        )
    content, found, start = decompress_lzf(bytes(body[8:end]), size=size), {}, 0
    for field in layouts[size]:
        if field.name in names:
            found[field.name] = np.frombuffer(content, field.kind, points, start)
        start += points * field.width
    return found


def _text_columns(header: _Header, body: bytes | memoryview, names: Sequence[str]) -> dict[str, np.ndarray]:
    lines = text_lines(bytes(body))
    layouts = {sum(field.count for field in fields): fields for fields in header.layouts}
    columns = len(lines[0].split()) if lines else 0
    columns = columns if columns in layouts else max(layouts)
    rows = number_rows(lines, rows=header.points, columns=columns)
    order = [field.name for field in layouts[columns] for _ in range(field.count)]
    return {name: rows[:, order.index(name)] for name in names}


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
