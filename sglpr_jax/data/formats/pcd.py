"""LZF decompression, for binary_compressed .pcd files. LZF data consists of literal runs and back references."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
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


def decompress_lzf(data: bytes, *, size: int) -> bytes:
    """Return the decompressed data.

    Arguments:
      data: Compressed data.
      size: Expected number of decompressed bytes.

    Raises:
      ValueError: If `data` is truncated, malformed or of another size.
    """
    out = bytearray()
    at, end = 0, len(data)
    try:
        while at < end:
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
            _copy(out, start, length + 2)
            if len(out) > size:
                break
    except IndexError as error:
        raise ValueError("expected LZF, found truncated data") from error
    if len(out) != size or at != end:
        raise ValueError(f"expected {size} decompressed bytes, found {len(out)}")
    return bytes(out)


def _copy(out: bytearray, start: int, length: int) -> None:
    """Append `length` bytes from `start`. The range may overlap the appended bytes."""
    whole = out[start : start + length]
    while len(whole) < length:
        whole += whole[: length - len(whole)]
    out += whole


_NUMBERS = {
    **{("F", 4): "<f4", ("F", 8): "<f8"},
    **{("I", 1): "<i1", ("I", 2): "<i2", ("I", 4): "<i4", ("I", 8): "<i8"},
    **{("U", 1): "<u1", ("U", 2): "<u2", ("U", 4): "<u4", ("U", 8): "<u8"},
}
"""Numpy types by TYPE and SIZE."""
KEYWORDS = ("VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS")
"""First words of the lines of a header, before that of DATA."""
AXES = ("x", "y", "z")


@dataclass(frozen=True)
class _Field:
    """Field of a point."""

    name: str
    """Name. Padding has the name `_`."""
    kind: str
    """TYPE: F, I or U."""
    size: int
    """Size of a number in bytes."""
    count: int
    """Number of values of this field in a point. Some programs write fields without values."""

    @property
    def width(self) -> int:
        """Size of the field in bytes."""
        return self.size * self.count


@dataclass(frozen=True)
class _Header:
    """Header of a .pcd file."""

    points: int
    """Number of points."""
    fields: tuple[_Field, ...]
    encoding: str
    """Word after DATA."""

    @property
    def unpadded(self) -> tuple[_Field, ...]:
        """Fields without padding. The Point Cloud Library writes padding only with `DATA binary`."""
        return tuple(field for field in self.fields if field.name != "_")


def read_pcd(path: Path) -> Float32[np.ndarray, "n 3"]:
    """Return the points (n, 3) of a .pcd file. Raises what `pcd_records` raises."""
    return pcd_records(path).points


def pcd_records(path: Path) -> Records:
    """Return the points and times of a .pcd file with `DATA binary`, `binary_compressed` or `ascii`, NaN included.

    Raises:
      FileNotFoundError: If the file does not exist.
      ValueError: If the header, the fields or the number of points are invalid.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a .pcd file, found none")
    try:
        return _decode(read_content(path))
    except ValueError as error:
        raise ValueError(f"{path}: expected a readable .pcd file, found an invalid one: {error}") from error


def pcd_blocks(path: Path) -> Iterator[Float64[np.ndarray, "_ 3"]]:
    """Yield the points of a .pcd file in parts. The file may have any size if it has `DATA binary`.

    Raises:
      FileNotFoundError: If the file does not exist.
      ValueError: If the file is invalid, or has another encoding and exceeds the size of a scan.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a .pcd file, found none")
    try:
        content = mapped_content(path)
        header, body = _split(content)
        if header.encoding != "binary":
            yield _decode(content).points.astype(np.float64)
            return
        points = _binary_records(header, body, AXES)
        yield from blocks_of(points, AXES)
    except ValueError as error:
        raise ValueError(f"{path}: expected a .pcd file of a map, preferably DATA binary, found {error}") from error


def _split(content: bytes | memoryview) -> tuple[_Header, bytes | memoryview]:
    """Header, and the bytes after it."""
    data = re.search(rb"^DATA[ \t]+(\w+)[^\n]*\n", content, flags=re.MULTILINE)
    if data is None:
        raise ValueError("expected a header that ends with a DATA line, found none")
    text = bytes(content[: data.start()]).decode("ascii", errors="replace")
    return _parse_header(text, data[1].decode(errors="replace")), content[data.end() :]


def _decode(content: bytes | memoryview) -> Records:
    header, body = _split(content)
    check_points(header.points, bytes_each=sum(field.width for field in header.fields))
    time = time_field_of([field.name for field in header.fields if field.count == 1])
    names = (*AXES, *([] if time is None else [time]))
    if header.encoding == "binary":
        found = _binary_records(header, body, names)
        return _records([found[name] for name in names], time)
    if header.encoding == "binary_compressed":
        return _records(_decode_compressed(header, bytes(body), names), time)
    if header.encoding == "ascii":
        return _records(_decode_ascii(header, bytes(body), names), time)
    raise ValueError(f"expected DATA binary, binary_compressed or ascii, found {header.encoding}")


def _parse_header(text: str, encoding: str) -> _Header:
    words = _keywords(text)
    missing = [keyword for keyword in ("FIELDS", "SIZE", "TYPE", "POINTS") if not words.get(keyword)]
    if missing:
        raise ValueError(f"expected a header with FIELDS, SIZE, TYPE and POINTS, found no {', '.join(missing)}")
    fields = _parse_fields(words)
    points = whole_number(words["POINTS"][0], of="POINTS")
    sides = [whole_number((words.get(side) or ["1"])[0], of=side) for side in ("WIDTH", "HEIGHT")]
    if "WIDTH" in words and sides[0] * sides[1] != points:
        raise ValueError(f"expected POINTS of WIDTH x HEIGHT, {sides[0]} x {sides[1]}, found {points}")
    return _Header(points, fields, encoding)


def _keywords(text: str) -> dict[str, list[str]]:
    """Words after each keyword of a header."""
    words: dict[str, list[str]] = {}
    for line in text.splitlines():
        keyword, *values = line.split() or ["#"]
        if keyword.startswith("#"):
            continue
        if keyword not in KEYWORDS:  # it may be a damaged one
            raise ValueError(f"expected {', '.join(KEYWORDS)} or a comment in the header, found {line[:80]!r}")
        if keyword in words:
            raise ValueError(f"expected each line of the header once, found {keyword} again")
        words[keyword] = values
    return words


def _parse_fields(words: dict[str, list[str]]) -> tuple[_Field, ...]:
    names = words["FIELDS"]
    counts = words.get("COUNT", ["1"] * len(names))
    if not len(names) == len(words["SIZE"]) == len(words["TYPE"]) == len(counts):
        raise ValueError(f"expected one SIZE, TYPE and COUNT for each of {len(names)} FIELDS, found another number")
    fields = tuple(
        _Field(name, kind.upper(), whole_number(size, of="SIZE"), whole_number(count, of="COUNT"))
        for name, kind, size, count in zip(names, words["TYPE"], words["SIZE"], counts, strict=True)
    )
    if any(names.count(axis) != 1 for axis in AXES):
        raise ValueError(f"expected the fields x, y and z, found {' '.join(names)}")
    for field in fields:
        ignored = field.name == "_" or not field.count
        if (field.name in AXES and field.count != 1) or (not ignored and (field.kind, field.size) not in _NUMBERS):
            raise ValueError(
                f"expected {field.name} of TYPE F, I or U and SIZE 1 to 8, and COUNT 1 for x, y and z, found TYPE"
                f" {field.kind}, SIZE {field.size} and COUNT {field.count}"
            )
    return fields


def _binary_records(header: _Header, body: bytes | memoryview, names: Sequence[str]) -> np.ndarray:
    """Records with the named fields."""
    offsets = list(accumulate((field.width for field in header.fields), initial=0))
    wanted = {field.name: column for column, field in enumerate(header.fields) if field.name in names}
    record = np.dtype(
        {
            "names": list(wanted),
            "formats": [_number(header.fields[column]) for column in wanted.values()],
            "offsets": [offsets[column] for column in wanted.values()],
            "itemsize": offsets[-1],
        }
    )
    end = header.points * record.itemsize
    if len(body) < end or bytes(body[end:]).strip(b"\0\r\n\t "):  # some programs fill the last page with zeros
        raise ValueError(f"expected {header.points} points of {record.itemsize} bytes, found {len(body)} bytes")
    return np.frombuffer(body, record, header.points)


def _decode_compressed(header: _Header, body: bytes, names: Sequence[str]) -> list[np.ndarray]:
    """Decode two sizes and LZF data, and return the named columns.

    The data contains one field after another: all x, all y and so on.
    """
    if len(body) < 8:
        raise ValueError(f"expected two sizes before the points, found {len(body)} bytes")
    packed, size = (int(number) for number in np.frombuffer(body, "<u4", count=2))
    layouts = (header.fields, header.unpadded)
    widths = [sum(field.width for field in fields) for fields in layouts]
    fitting = [fields for fields, width in zip(layouts, widths, strict=True) if size == header.points * width]
    end = 8 + packed
    if not fitting or len(body) < end or body[end:].strip(b"\0\r\n\t "):
        raise ValueError(
            f"expected {header.points} points of {widths[0]} bytes in {packed} bytes, found {size} in {len(body) - 8}"
        )
    columns = decompress_lzf(body[8:end], size=size)
    starts = [header.points * offset for offset in accumulate((field.width for field in fitting[0]), initial=0)]
    found = {
        field.name: np.frombuffer(columns, _number(field), count=header.points, offset=start)
        for field, start in zip(fitting[0], starts, strict=False)
        if field.name in names
    }
    return [found[name] for name in names]


def _decode_ascii(header: _Header, body: bytes, names: Sequence[str]) -> list[np.ndarray]:
    lines = text_lines(body)
    words = len(lines[0].split()) if lines else 0
    padded = words == sum(field.count for field in header.fields)
    fields = header.fields if padded or words != sum(field.count for field in header.unpadded) else header.unpadded
    offsets = list(accumulate((field.count for field in fields), initial=0))
    rows = number_rows(lines, rows=header.points, columns=offsets[-1])
    order = [field.name for field in fields]
    return [rows[:, offsets[order.index(name)]] for name in names]


def _number(field: _Field) -> str:
    return _NUMBERS[field.kind, field.size]


def _records(columns: Sequence[np.ndarray], time: str | None) -> Records:
    """Points of the columns x, y, z, and the times in the column after them if it has a name."""
    with np.errstate(over="ignore", invalid="ignore"):  # invalid points are dropped by the callers
        points = np.stack([axis.astype(np.float32) for axis in columns[:3]], axis=1)
    return Records(points, None, None if time is None else TimeField(time, columns[3].copy()))
