"""Scans as other sensors, weather and headings would have them, for training: rotated, and some with points lost.

A scan alone decides what happens to it, so that whoever writes a dataset, and in how many goes, writes the same bytes.
"""

import zlib

import numpy as np
from jaxtyping import Bool, Float32, Int

from sglpr_jax.data.corruption.corruptions import Corruption, corrupt
from sglpr_jax.data.mounting import Mounting
from sglpr_jax.data.views import rotated

THINNED, FEWER_BEAMS = 0.4, 0.3
"""The share of the scans that lose points at random, and of those that lose whole rings; the rest stays whole."""
MOST_LOST = 0.95
"""Of the points of a scan; every share up to it is as likely."""
BEAMS = (32.0, 16.0)
"""How many may be left."""


def vary(
    points: Float32[np.ndarray, "n 3"], labels: Int[np.ndarray, " n"], mounting: Mounting | None
) -> tuple[Float32[np.ndarray, "m 3"], Int[np.ndarray, " m"]]:
    """What is left of a scan (metres, LiDAR frame) and its labels, levelled and rotated about z by any angle.

    The rotation comes before any image is made: one of an image would blur its cells.
    """
    seed = zlib.crc32(points.tobytes())
    left = _left(points, np.random.default_rng(seed))
    points, labels = points[left], labels[left]
    points = points if mounting is None else mounting.level(points)
    return rotated(points, 2 * np.pi * seed / 2**32), labels


def _left(points: Float32[np.ndarray, "n 3"], rng: np.random.Generator) -> Bool[np.ndarray, " n"]:
    kind, strength = rng.random(), rng.random()
    if kind < THINNED:
        corruption = Corruption("dropout", MOST_LOST * strength)
    elif kind < THINNED + FEWER_BEAMS:
        corruption = Corruption("beams", BEAMS[int(len(BEAMS) * strength)])
    else:
        corruption = Corruption("clean")
    return corrupt(points, corruption, rng=rng)[1]
