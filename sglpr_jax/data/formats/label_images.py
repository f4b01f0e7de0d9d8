"""Label images of ready-made BEV images: the class of each pixel.

The label image `00/labels/000000.png` belongs to `00/imgs/000000.png` and has the same size and orientation. Each pixel
has 16 bits and contains a raw SemanticKITTI id. The id 0 is an empty pixel or an unknown class.

Raw ids, like those of scans, can be mapped to all class settings of docs/reference/labels.md. The ids of moving objects
do not fit into 8 bits.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Int, Int32, UInt16

from sglpr_jax.data.formats.grey_png import read_grey_png
from sglpr_jax.files import naming
from sglpr_jax.labels import to_classes


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
