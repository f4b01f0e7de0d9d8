"""Reads points from .pcd files, the format of the Point Cloud Library."""

import re
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from sglpr_jax.data.formats.lzf import decompress_lzf


def read_pcd(path: Path) -> Float32[np.ndarray, "n 3"]:
    """Return the points (n, 3) of a .pcd file with `DATA binary`, `binary_compressed` or `ascii`, NaN points included.

    Raises:
      FileNotFoundError: If the file does not exist.
      ValueError: If the header, the fields or the number of points are invalid.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a .pcd file, found none")
    try:
        return _decode(path.read_bytes())
    except (ValueError, TypeError) as error:  # TypeError: a TYPE unknown to numpy
        raise ValueError(f"{path}: expected a readable .pcd file, found an invalid one: {error}") from error


@dataclass(frozen=True)
class _Header:
    """Header of a .pcd file."""

    points: int
    """Number of points."""
    fields: tuple[str, ...]
    """Names of the fields of a point."""
    dtypes: tuple[np.dtype, ...]
    """Numpy type of each field."""
    counts: tuple[int, ...]
    """Number of elements of each field."""


def _decode(content: bytes) -> Float32[np.ndarray, "n 3"]:
    data = re.search(rb"^DATA\s+(\w+)[^\n]*\n", content, flags=re.MULTILINE)
    if data is None:
        raise ValueError("expected a header that ends with a DATA line, found none")
    header = _parse_header(content[: data.start()].decode("ascii", errors="replace"))
    encoding, body = data[1], content[data.end() :]
    if encoding == b"binary":
        return _decode_binary(header, body)
    if encoding == b"binary_compressed":
        return _decode_compressed(header, body)
    if encoding == b"ascii":
        return _decode_ascii(header, body)
    raise ValueError(f"expected DATA binary, binary_compressed or ascii, found {encoding.decode()}")


def _parse_header(text: str) -> _Header:
    words = {line.split()[0]: line.split()[1:] for line in text.splitlines() if line.strip()}
    missing = [keyword for keyword in ("FIELDS", "SIZE", "TYPE", "POINTS") if not words.get(keyword)]
    if missing:
        raise ValueError(f"expected a header with FIELDS, SIZE, TYPE and POINTS, found no {', '.join(missing)}")
    fields = words["FIELDS"]
    counts = words.get("COUNT", ["1"] * len(fields))
    if not {"x", "y", "z"} <= set(fields):
        raise ValueError(f"expected the fields x, y and z, found {' '.join(fields)}")
    if not len(fields) == len(words["SIZE"]) == len(words["TYPE"]) == len(counts):
        raise ValueError(f"expected one SIZE, TYPE and COUNT for each of {len(fields)} FIELDS, found others")
    if int(words["POINTS"][0]) < 1:
        raise ValueError(f"expected at least one point, found POINTS {words['POINTS'][0]}")
    width, height = (words.get(side) or ["1"] for side in ("WIDTH", "HEIGHT"))
    if "WIDTH" in words and int(width[0]) * int(height[0]) != int(words["POINTS"][0]):
        raise ValueError(f"expected POINTS of WIDTH x HEIGHT, {width[0]} x {height[0]}, found {words['POINTS'][0]}")
    if any(int(count) < 1 for count in counts):
        raise ValueError(f"expected a COUNT of 1 or more for each field, found {' '.join(counts)}")
    return _Header(
        points=int(words["POINTS"][0]),
        fields=tuple(fields),
        dtypes=tuple(
            np.dtype(f"<{kind.lower()}{size}") for kind, size in zip(words["TYPE"], words["SIZE"], strict=True)
        ),
        counts=tuple(int(count) for count in counts),
    )


def _decode_binary(header: _Header, body: bytes) -> Float32[np.ndarray, "n 3"]:
    widths = [dtype.itemsize * count for dtype, count in zip(header.dtypes, header.counts, strict=True)]
    offsets = list(accumulate(widths, initial=0))
    columns = [header.fields.index(axis) for axis in "xyz"]
    record = np.dtype(
        {
            "names": ["x", "y", "z"],
            "formats": [header.dtypes[column] for column in columns],
            "offsets": [offsets[column] for column in columns],
            "itemsize": offsets[-1],
        }
    )
    if len(body) < header.points * record.itemsize:
        raise ValueError(f"expected {header.points} points of {record.itemsize} bytes, found {len(body)} bytes")
    records = np.frombuffer(body, dtype=record, count=header.points)
    return np.stack([records[axis] for axis in "xyz"], axis=1).astype(np.float32)


def _decode_compressed(header: _Header, body: bytes) -> Float32[np.ndarray, "n 3"]:
    """Decode two sizes and LZF data. The data contains one field after another: all x, all y and so on."""
    if len(body) < 8:
        raise ValueError(f"expected two sizes before the points, found {len(body)} bytes")
    packed, size = (int(number) for number in np.frombuffer(body, "<u4", count=2))
    widths = [dtype.itemsize * count for dtype, count in zip(header.dtypes, header.counts, strict=True)]
    if size != header.points * sum(widths) or len(body) < 8 + packed:
        raise ValueError(
            f"expected {header.points} points of {sum(widths)} bytes in {packed} bytes, found {size} in {len(body) - 8}"
        )
    columns = decompress_lzf(body[8 : 8 + packed], size=size)
    starts = [header.points * offset for offset in accumulate(widths, initial=0)]
    found = [
        np.frombuffer(columns, header.dtypes[field], count=header.points * header.counts[field], offset=starts[field])
        for field in map(header.fields.index, "xyz")
    ]
    return np.stack([column[:: len(column) // header.points] for column in found], axis=1).astype(np.float32)


def _decode_ascii(header: _Header, body: bytes) -> Float32[np.ndarray, "n 3"]:
    offsets = list(accumulate(header.counts, initial=0))
    rows = [line.split() for line in body.decode("ascii", errors="replace").splitlines() if line.strip()]
    if len(rows) != header.points or any(len(row) != offsets[-1] for row in rows):
        raise ValueError(f"expected {header.points} lines of {offsets[-1]} numbers, found {len(rows)} lines or others")
    columns = [offsets[header.fields.index(axis)] for axis in "xyz"]
    return np.array([[row[column] for column in columns] for row in rows], dtype=np.float32)
