"""Varied scans for training: rotated about z, some with lost points, as with other sensors, weather and headings.

The variation of a scan depends only on its points. A dataset therefore has the same bytes, even if its writing was
interrupted.
"""

import zlib

import numpy as np
from jaxtyping import Bool, Float32, Int

from sglpr_jax.data.corruption import Corruption, corrupt, ring_numbers
from sglpr_jax.data.mounting import Mounting
from sglpr_jax.data.views import rotated

THINNED, FEWER_BEAMS = 0.4, 0.3
"""Fraction of the scans that lose random points, and fraction that loses whole rings. Other scans keep all points."""
MOST_LOST = 0.95
"""Maximum fraction of the points of a scan that are lost. The fraction is uniformly distributed."""
BEAMS = (32.0, 16.0)
"""Possible numbers of remaining beams."""


def vary(
    points: Float32[np.ndarray, "n 3"], labels: Int[np.ndarray, " n"], mounting: Mounting | None
) -> tuple[Float32[np.ndarray, "m 3"], Int[np.ndarray, " m"]]:
    """Removes points of some scans, levels the scan, and rotates it about z by a random angle.

    The random seed is a hash of the points. The points are rotated because a rotation of the image would blur its
    cells.

    Arguments:
      points: Points in the LiDAR frame, in metres.
      labels: Labels of the points.
      mounting: Mounting of the LiDAR. None is the mounting that the models expect.

    Returns:
      Remaining points and their labels.
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
    elif kind < THINNED + FEWER_BEAMS and _has_rings(points):
        corruption = Corruption("beams", BEAMS[int(len(BEAMS) * strength)])
    else:
        corruption = Corruption("clean")
    return corrupt(points, corruption, rng=rng)[1]


def _has_rings(points: Float32[np.ndarray, "n 3"]) -> bool:
    """Whether the points are those of rings. Submaps and sensors of other patterns keep all points instead."""
    try:
        ring_numbers(points)
    except ValueError:
        return False
    return True
