"""Static background of the images of a moving sensor, such as rings on a flat floor and the vehicle itself.

The background moves with the sensor. Images of different places agree in it best at zero shift and rotation, so it
says nothing about the place or the motion.
"""

import numpy as np
from jaxtyping import Float32, UInt8


class Background:
    """Exponential moving average of the square roots of images, for subtraction."""

    def __init__(self, *, frames: int, least: int):
        """`frames` is the length of the average. Nothing is subtracted before `least` images."""
        self.frames, self.least = frames, least
        self.added = 0
        """Number of added images."""
        self._root: Float32[np.ndarray, "n n"] | None = None

    def add(self, image: UInt8[np.ndarray, "n n"]) -> None:
        """Adds an image to the average. It should show another place than the last one."""
        root = np.sqrt(image, dtype=np.float32)
        self.added += 1
        self._root = root if self._root is None else self._root + (root - self._root) / min(self.added, self.frames)

    def without(self, image: UInt8[np.ndarray, "n n"]) -> UInt8[np.ndarray, "n n"]:
        """Returns an image without the background. Square roots are subtracted, as in the comparison."""
        if not image.size or self._root is None or self.added < self.least:
            return image
        more = np.maximum(np.sqrt(image, dtype=np.float32) - self._root, 0)
        return np.round(more**2).astype(np.uint8)
