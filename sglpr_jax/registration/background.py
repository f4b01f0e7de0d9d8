"""Static background of the images of a moving sensor, such as rings on a flat floor and the vehicle itself.

The background moves with the sensor. Images of different places agree in it best at zero shift and rotation, so it
says nothing about the place or the motion.
"""

import functools

import numpy as np
from jaxtyping import Float32, Int, UInt8

FRAMES = 16
"""Number of keyframes in the average."""
MIN_FRAMES = 4
"""Minimum number of keyframes before the average is subtracted."""


class Background:
    """Exponential moving average of the square roots of images, for subtraction."""

    def __init__(self):
        self.added = 0
        """Number of added images."""
        self._root: Float32[np.ndarray, "n n"] | None = None

    def add(self, image: UInt8[np.ndarray, "n n"]) -> None:
        """Adds an image to the average. It should show another place than the last one."""
        root = np.sqrt(image, dtype=np.float32)
        self.added += 1
        self._root = root if self._root is None else self._root + (root - self._root) / min(self.added, FRAMES)

    def without(self, image: UInt8[np.ndarray, "n n"]) -> UInt8[np.ndarray, "n n"]:
        """Returns an image without the background. Square roots are subtracted, as in the comparison."""
        if not image.size:
            return image
        root = np.sqrt(image, dtype=np.float32)
        background = ring_medians(root)
        if self._root is not None and self.added >= MIN_FRAMES:
            background = np.maximum(self._root, background)
        return np.round(np.maximum(root - background, 0) ** 2).astype(np.uint8)


def ring_medians(image: Float32[np.ndarray, "n n"]) -> Float32[np.ndarray, "n n"]:
    """Median of the cells of each ring around the sensor. It is above 0 where a flat floor or ceiling is a ring."""
    order, starts, ring = _rings(len(image))
    medians = [np.median(cells) for cells in np.split(image.reshape(-1)[order], starts)]
    return np.array(medians, np.float32)[ring]


@functools.cache
def _rings(size: int) -> tuple[Int[np.ndarray, " c"], Int[np.ndarray, " r"], Int[np.ndarray, "n n"]]:
    """Cells in the order of their rings, the start of each further ring in this order, and the ring of each cell."""
    axis = np.arange(size) - (size - 1) / 2
    ring = np.hypot(axis[:, None], axis[None]).astype(int)
    return np.argsort(ring, axis=None, kind="stable"), np.cumsum(np.bincount(ring.reshape(-1)))[:-1], ring
