"""Background of images, which moves with the sensor: rings on a flat floor, and the vehicle itself.

Images of any two places agree in it at zero shift and rotation, so it says nothing about the place or the motion.
"""

import functools

import numpy as np
from jaxtyping import Float32, Int, UInt8

FRAMES = 16
"""Number of images in the average: a further one has at least the weight 1 / `FRAMES`."""
MIN_FRAMES = 4
"""Minimum number of images before the average is subtracted."""


class Background:
    """Moving average of the square roots of images, which is subtracted from further images."""

    def __init__(self):
        self.added = 0
        """Number of added images."""
        self._root: Float32[np.ndarray, "n n"] | None = None

    def add(self, image: UInt8[np.ndarray, "n n"]) -> None:
        """Add an image to the average. It should be taken at another position than the previous one."""
        root = np.sqrt(image, dtype=np.float32)
        self.added += 1
        self._root = root if self._root is None else self._root + (root - self._root) / min(self.added, FRAMES)

    def without(self, image: UInt8[np.ndarray, "n n"]) -> UInt8[np.ndarray, "n n"]:
        """Return an image less its background, with a lower limit of 0, computed on square roots of the cells.

        The background of a cell is the median of its ring in this image or, if it is larger, the running average of the
        cell over the added images (from `MIN_FRAMES` images on).
        """
        if not image.size:
            return image
        root = np.sqrt(image, dtype=np.float32)
        background = ring_medians(image)  # square roots, because the comparison of images uses them, too
        if self._root is not None and self.added >= MIN_FRAMES:
            background = np.maximum(self._root, background)
        return np.round(np.maximum(root - background, 0) ** 2).astype(np.uint8)


def ring_medians(image: UInt8[np.ndarray, "n n"]) -> Float32[np.ndarray, "n n"]:
    """Median of the square roots of each cell's ring around the sensor. Flat floors and ceilings fill whole rings."""
    ring = _ring_of_cell(len(image))
    values = 256 * ring + image  # distinguishes the values of all rings, so that one count serves all medians
    at_most = np.bincount(values.reshape(-1), minlength=256 * (ring.max() + 1)).reshape(-1, 256).cumsum(axis=1)
    cells = at_most[:, -1:]
    middle_values = [(at_most <= before).sum(axis=1) for before in ((cells - 1) // 2, cells // 2)]
    return np.sqrt(middle_values, dtype=np.float32).mean(axis=0)[ring]


@functools.cache
def _ring_of_cell(size: int) -> Int[np.ndarray, "n n"]:
    """Number of the ring of each cell of a square image of `size` x `size` cells. Rings are one cell wide."""
    axis = np.arange(size) - (size - 1) / 2
    return np.hypot(axis[:, None], axis[None]).astype(int)
