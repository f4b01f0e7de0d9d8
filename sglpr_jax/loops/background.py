"""What all images of a moving sensor show at the same cells: rings on a flat floor, the vehicle itself.

Such a pattern moves with the sensor, not with the place. Two images of any two places agree in it, best of all at the
same pose, so that neither a loop nor the motion can be told by it.
"""

import numpy as np
from jaxtyping import Float32, UInt8


class Background:
    """Exponential moving average of the square roots of images, and images without it."""

    def __init__(self, *, frames: int, least: int):
        """`frames` is the length of the average; before `least` images nothing is taken away."""
        self.frames, self.least = frames, least
        self.seen = 0
        """Number of images so far."""
        self._root: Float32[np.ndarray, "n n"] | None = None

    def add(self, image: UInt8[np.ndarray, "n n"]) -> None:
        """Add the image of a frame that shows another place than the last one."""
        root = np.sqrt(image, dtype=np.float32)
        self.seen += 1
        self._root = root if self._root is None else self._root + (root - self._root) / min(self.seen, self.frames)

    def without(self, image: UInt8[np.ndarray, "n n"]) -> UInt8[np.ndarray, "n n"]:
        """Return what an image shows beyond the average. Comparisons see square roots, which are subtracted."""
        if not image.size or self._root is None or self.seen < self.least:
            return image
        more = np.maximum(np.sqrt(image, dtype=np.float32) - self._root, 0)
        return np.round(more**2).astype(np.uint8)
