"""Reads the greyscale PNG files of BEVPlace's layout: density images and label images.

The images are rotated to the orientation of the paper's eq. 1: x (forward) to the right, y (left) up.
"""

import io
from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int, Int32, UInt, UInt16
from PIL import Image

from sglpr_jax.data.scan import Scan
from sglpr_jax.files import in_short, naming
from sglpr_jax.labels import to_classes

_MODES = {8: "L", 16: "I;16"}
"""Pillow's mode of grey images, by bits per pixel."""
LARGEST_SIDE = 1 << 13
"""Maximum width and height of an image, in pixels."""


def read_grey_png(path: Path, *, bits: int) -> UInt[np.ndarray, "h w"]:
    """Return a greyscale image of 8 or 16 bits per pixel, in the orientation of eq. 1: x to the right, y up."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected an image, found none")
    expected = f"{'an 8' if bits == 8 else 'a 16'}-bit grey PNG"
    try:
        content = path.read_bytes()
        with Image.open(io.BytesIO(content), formats=["PNG"]) as image:
            mode, size = image.mode, image.size
            if max(size) > LARGEST_SIDE:
                raise ValueError(f"{size[0]} x {size[1]} pixels, more than {LARGEST_SIDE} a side")
            image.verify()  # checks the checksums, after which Pillow requires that the file is opened again
        with Image.open(io.BytesIO(content), formats=["PNG"]) as image:
            pixels = np.asarray(image)
    except Exception as error:  # Pillow raises many types for damaged files
        raise ValueError(f"{path}: expected {expected}, found another or a damaged file ({in_short(error)})") from error
    if mode != _MODES[bits]:
        raise ValueError(f"{path}: expected {expected} (mode {_MODES[bits]}), found mode {mode}")
    return np.rot90(pixels, -1)


def image_scan(path: Path, labels: Path | None = None, *, read: Callable[[Path], Float32[np.ndarray, "h w"]]) -> Scan:
    """Read a ready-made image with `read`, and its label image if any, for a `Recording`."""
    image = read(path)
    return Scan(image=image, labels=None if labels is None else read_label_image(labels, shape=image.shape))


def read_label_image(path: Path, *, shape: tuple[int, int]) -> Int32[np.ndarray, "h w"]:
    """Return the SemanticKITTI ids of a 16-bit label image, in the orientation of eq. 1: x to the right, y up."""
    ids = read_grey_png(path, bits=16).astype(np.int32)
    if ids.shape != shape:
        # The array is the file rotated by 90 degrees, so its first axis is the columns of the file.
        expected, found = (f"{rows} rows of {columns} pixels" for columns, rows in (shape, ids.shape))
        raise ValueError(f"{path}: expected {expected}, the size of the image, found {found}")
    with naming(path):
        to_classes(ids)  # raises for unknown ids
    return ids


def label_image_pixels(ids: Int[np.ndarray, "h w"]) -> UInt16[np.ndarray, "w h"]:
    """Convert SemanticKITTI ids in the orientation of eq. 1 to the pixels of a label image file."""
    return np.ascontiguousarray(np.rot90(ids), np.uint16)
