"""Reads the greyscale PNG files of BEVPlace's layout.

The images are rotated to the orientation of eq. 1, with x (forward) to the right and y (left) up.
"""

import io
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Int, Int32, UInt, UInt16
from PIL import Image

from sglpr_jax.files import in_short, naming
from sglpr_jax.labels import to_classes

_MODES = {8: "L", 16: "I;16"}
_SIGNATURE = b"\x89PNG\r\n\x1a\n"
LARGEST_SIDE = 1 << 13
"""Maximum width and height of an image, in pixels. Pillow accepts images of this size."""
_ADAM7 = ((0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2))
"""First column and row, and steps of columns and rows, of each pass of an interlaced image."""


def read_grey_png(path: Path, *, bits: int) -> UInt[np.ndarray, "h w"]:
    """Return an image (h, w) in the orientation of eq. 1.

    Arguments:
      path: PNG file.
      bits: Bits per pixel, 8 or 16.

    Raises:
      FileNotFoundError: If the file does not exist.
      ValueError: If the file is not a complete greyscale image with this number of bits.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected an image, found none")
    expected = f"{'an 8' if bits == 8 else 'a 16'}-bit grey PNG"
    try:
        content = path.read_bytes()
        _check_whole(content)
        with Image.open(io.BytesIO(content)) as image:
            mode, grey = image.mode, np.asarray(image)
    except (ValueError, OSError, SyntaxError, struct.error, zlib.error) as error:
        raise ValueError(f"{path}: expected {expected}, found another or a damaged file ({in_short(error)})") from error
    if mode != _MODES[bits]:
        raise ValueError(f"{path}: expected {expected} (mode {_MODES[bits]}), found mode {mode}")
    return np.rot90(grey, -1)


def _check_whole(content: bytes) -> None:
    """Raise ValueError if a checksum is wrong or pixels are missing or too many. Pillow reports none of these."""
    if not content.startswith(_SIGNATURE):
        raise ValueError("no PNG signature")
    chunks = list(_chunks(content))
    if not chunks or chunks[0][0] != b"IHDR" or chunks[-1][0] != b"IEND":
        raise ValueError("the header or the end is missing")
    width, height, depth, colour, _, _, interlaced = struct.unpack(">IIBBBBB", chunks[0][1])
    if max(width, height) > LARGEST_SIDE:
        raise ValueError(f"the header declares {width} x {height} pixels, more than {LARGEST_SIDE} a side")
    bits = depth * {2: 3, 4: 2, 6: 4}.get(colour, 1)
    size = sum(_pass_bytes(width, height, bits, step) for step in (_ADAM7 if interlaced else ((0, 0, 1, 1),)))
    unpacking = zlib.decompressobj()
    pixels = unpacking.decompress(b"".join(data for kind, data in chunks if kind == b"IDAT"), size + 1)
    if len(pixels) != size or not unpacking.eof:
        raise ValueError(f"the header declares {width} x {height} pixels, but the data has another size")


def _pass_bytes(width: int, height: int, bits: int, steps: tuple[int, int, int, int]) -> int:
    """Size of one pass over an image in bytes. Each row begins with the number of its filter."""
    x, y, dx, dy = steps
    columns, rows = -((x - width) // dx), -((y - height) // dy)
    return rows * (1 + (columns * bits + 7) // 8) if columns > 0 and rows > 0 else 0


def _chunks(content: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Type and data of each chunk of a PNG."""
    at = len(_SIGNATURE)
    while at < len(content):
        (size,) = struct.unpack_from(">I", content, at)
        kind, data = content[at + 4 : at + 8], content[at + 8 : at + 8 + size]
        (checksum,) = struct.unpack_from(">I", content, at + 8 + size)
        if zlib.crc32(kind + data) != checksum:
            raise ValueError(f"the checksum of chunk {kind!r} is wrong")
        yield kind, data
        at += 12 + size
        if kind == b"IEND":
            return


def read_label_image(path: Path, *, shape: tuple[int, int]) -> Int32[np.ndarray, "h w"]:
    """Return the raw ids (h, w) in the orientation of eq. 1.

    Arguments:
      path: Label image.
      shape: Expected shape (h, w), that of the BEV image.

    Raises:
      FileNotFoundError: If the file does not exist.
      ValueError: If the file is not a complete 16-bit greyscale image, has another shape, or contains unknown ids.
    """
    raw = read_grey_png(path, bits=16).astype(np.int32)
    if raw.shape != shape:
        expected, found = (f"{rows} rows of {columns} pixels" for columns, rows in (shape, raw.shape))
        raise ValueError(f"{path}: expected {expected}, the size of the image, found {found}")
    with naming(path):
        to_classes(raw)
    return raw


def label_image_pixels(raw: Int[np.ndarray, "h w"]) -> UInt16[np.ndarray, "w h"]:
    """Convert raw ids in the orientation of eq. 1 to the pixels of a label image file."""
    return np.ascontiguousarray(np.rot90(raw), np.uint16)
