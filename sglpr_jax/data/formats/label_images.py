"""Label images of ready-made BEV images: what each pixel of an image shows.

    00/labels/000000.png   of 00/imgs/000000.png: as large and as oriented, 16 bits a pixel, a raw SemanticKITTI id

0 is an empty pixel or one whose class is not known. Raw ids, as beside scans, can be sorted into any of the settings
of docs/reference/labels.md; those of moving things do not fit 8 bits.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Int, Int32, UInt16

from sglpr_jax.data.formats.grey_png import read_grey_png
from sglpr_jax.labels import to_classes


def read_label_image(path: Path, *, shape: tuple[int, int]) -> Int32[np.ndarray, "h w"]:
    """Return the raw ids of an image of this shape (h, w), both in eq. 1's orientation.

    Raises FileNotFoundError, and ValueError where the file is no whole 16-bit grey image, has another size than its
    image, or holds ids that do not exist.
    """
    raw = read_grey_png(path, bits=16).astype(np.int32)
    if raw.shape != shape:
        expected, found = (f"{rows} rows of {columns} pixels" for columns, rows in (shape, raw.shape))
        raise ValueError(f"{path}: expected {expected}, as the image has, found {found}")
    try:
        to_classes(raw)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    return raw


def label_image_pixels(raw: Int[np.ndarray, "h w"]) -> UInt16[np.ndarray, "w h"]:
    """Return the pixels of a label image's file from raw ids in eq. 1's orientation."""
    return np.ascontiguousarray(np.rot90(raw), np.uint16)
