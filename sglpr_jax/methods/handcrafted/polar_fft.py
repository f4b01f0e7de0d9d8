"""Polar-FFT: a descriptor of a BEV image without training, nearly invariant to rotation of the scan."""

import numpy as np
from jaxtyping import Float32, Num

from sglpr_jax.methods.pairwise import unit_length

RINGS = 20
SECTORS = 60
FREQUENCIES = 16
SCALE = 25.5
"""Factor of the counts. It maps counts of 0 to 10 to the grey values 0 to 255 of BEVPlace's images."""
READY_MADE_RADIUS = 62.0
"""Distance from the centre up to which the ready-made images of KITTI have content, in pixels."""


def polar_fft(images: Num[np.ndarray, "n h w"], *, radius: float | None = None) -> Float32[np.ndarray, "n 320"]:
    """Return one unit-length descriptor for each image of point counts. An image without points gives zeros.

    The counts are summed in 20 rings x 60 sectors and become log(1 + 25.5 * sum). Each ring keeps the magnitudes of its
    16 lowest frequencies along the sectors, which a rotation by whole sectors does not change.

    Arguments:
      images: Images of point counts, whose middle is the sensor.
      radius: Distance from the sensor, in pixels, at which cells are ignored. None: half the shorter side.
    """
    height, width = images.shape[1:]
    radius = radius or min(height, width) / 2
    rows, columns = np.indices((height, width))
    y, x = rows - (height - 1) / 2, columns - (width - 1) / 2
    distance = np.hypot(y, x)
    ring = np.floor(distance / radius * RINGS).astype(np.int64)
    sector = np.floor(np.arctan2(y, x) / (2 * np.pi) * SECTORS).astype(np.int64) % SECTORS
    is_inside = distance < radius
    cells = (ring * SECTORS + sector)[is_inside]
    sums = [np.bincount(cells, weights=image[is_inside], minlength=RINGS * SECTORS) for image in images]
    polar = np.log1p(SCALE * np.reshape(sums, (-1, RINGS, SECTORS)))
    spectrum = np.abs(np.fft.rfft(polar, axis=2))[:, :, :FREQUENCIES].reshape(len(images), -1)
    return unit_length(spectrum)
