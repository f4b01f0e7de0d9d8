"""Grey PNGs of BEVPlace's layout. Their rows run backwards; eq. 1 has x (forward) to the right and y (left) up."""

from pathlib import Path

import numpy as np
from jaxtyping import UInt
from PIL import Image

_MODES = {8: "L", 16: "I;16"}


def read_grey_png(path: Path, *, bits: int) -> UInt[np.ndarray, "h w"]:
    """Return an image (h, w) in eq. 1's orientation.

    Raises FileNotFoundError, and ValueError where the file is no whole grey image of so many `bits` (8 or 16) a pixel.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    expected = f"{'an 8' if bits == 8 else 'a 16'}-bit grey PNG"
    try:
        with Image.open(path) as image:
            mode, grey = image.mode, np.asarray(image)
    except (OSError, SyntaxError) as error:  # what Pillow raises for a cut-off or broken PNG
        raise ValueError(f"{path}: expected {expected}, found no such image ({error})") from error
    if mode != _MODES[bits]:
        raise ValueError(f"{path}: expected {expected} (mode {_MODES[bits]}), found mode {mode}")
    return np.rot90(grey, -1)
