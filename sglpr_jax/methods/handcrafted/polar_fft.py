"""Polar-FFT: a descriptor of a BEV image without training, nearly invariant to rotation of the scan."""

from functools import partial

import numpy as np
from jaxtyping import Float32, Int, Num

from sglpr_jax.methods.method import HandcraftedMethod
from sglpr_jax.methods.pairwise import unit_length

RINGS = 20
SECTORS = 60
FREQUENCIES = 16
READY_MADE_RADIUS = 62.0
"""Distance from the centre up to which the ready-made images of KITTI have content, in pixels."""


def polar_fft(
    images: Num[np.ndarray, "n h w"],
    *,
    centre: tuple[float, float] | None = None,
    radius: float | None = None,
    scale: float = 25.5,
) -> Float32[np.ndarray, "n 320"]:
    """Return one unit-length descriptor per image of point counts. An image without points gives zeros.

    The counts are summed in 20 rings x 60 sectors and become log(1 + scale * sum). Each ring keeps the magnitudes of
    its 16 lowest frequencies along the sectors, which a shift of the sectors does not change.

    Arguments:
      images: Images of point counts.
      centre: Row and column of the centre. None: the middle of the image.
      radius: Outer radius in pixels; cells at this distance or beyond are ignored. None: half the shorter side.
      scale: Factor of the sums. The default maps counts of 0 to 10 to the grey values 0 to 255 of BEVPlace's images.
    """
    height, width = images.shape[1:]
    bins = _polar_bins(
        height,
        width,
        centre=centre or ((height - 1) / 2, (width - 1) / 2),
        radius=radius or min(height, width) / 2,
    )
    inside = bins >= 0
    sums = [np.bincount(bins[inside], weights=image[inside], minlength=RINGS * SECTORS) for image in images]
    polar = np.log1p(scale * np.reshape(sums, (-1, RINGS, SECTORS)))
    spectrum = np.abs(np.fft.rfft(polar, axis=2))[:, :, :FREQUENCIES].reshape(len(images), -1)
    return unit_length(spectrum)


def _polar_bins(
    height: int, width: int, *, centre: tuple[float, float], radius: float
) -> Int[np.ndarray, "{height} {width}"]:
    """Return ring * SECTORS + sector for every pixel, or -1 at `radius` and beyond."""
    rows, columns = np.indices((height, width))
    down, right = rows - centre[0], columns - centre[1]
    distance = np.hypot(down, right)
    ring = np.floor(distance / radius * RINGS).astype(np.int64)
    sector = np.floor(np.arctan2(down, right) / (2 * np.pi) * SECTORS).astype(np.int64) % SECTORS
    return np.where(distance < radius, ring * SECTORS + sector, -1)


POLAR_FFT = HandcraftedMethod(
    "polar-fft",
    "this project",
    "images",
    polar_fft,
    describe_ready_made=partial(polar_fft, radius=READY_MADE_RADIUS),
)
