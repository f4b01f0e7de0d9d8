"""Thumbnail: the BEV image, reduced in size. A simple baseline, most of all for rotated scans."""

import numpy as np
from jaxtyping import Float32, Num

from sglpr_jax.methods.method import HandcraftedMethod
from sglpr_jax.methods.unit_length import unit_length

SIDE = 25


def thumbnail(images: Num[np.ndarray, "n h w"]) -> Float32[np.ndarray, "n 625"]:
    """Return one unit-length descriptor per image: its means over 25 x 25 equal blocks. An empty image gives zeros.

    A pixel on a border between blocks counts in each block in proportion to its area there.
    """
    n, height, width = images.shape
    blocks = _block_means(height) @ images @ _block_means(width).T
    return unit_length(blocks.reshape(n, SIDE * SIDE))


def _block_means(size: int) -> Float32[np.ndarray, "25 {size}"]:
    """Return the matrix that maps `size` pixels to the means of 25 equal blocks."""
    edges = np.linspace(0, size, SIDE + 1)
    pixels = np.arange(size)
    overlap = np.minimum(edges[1:, None], pixels + 1) - np.maximum(edges[:-1, None], pixels)
    return (np.maximum(overlap, 0) * (SIDE / size)).astype(np.float32)


THUMBNAIL = HandcraftedMethod(
    "thumbnail",
    "this project: the image made small",
    "images",
    thumbnail,
)
