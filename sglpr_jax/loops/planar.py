"""Poses and loops in the plane of the ground, as rows of x, y (metres) and yaw (radians)."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from sglpr_jax.loops.loop import DEGENERATE_M, Loop
from sglpr_jax.loops.mountings import AnyMounting, uprights
from sglpr_jax.loops.transforms import moved_covariance, yaw_of
from sglpr_jax.loops.upright import upright_poses

Planar = Float[np.ndarray, "... 3"]
"""Poses in the plane: x, y, yaw."""

SEEN = np.array([0, 1, 5])
"""Rows of x, y and yaw in a covariance of 6 degrees of freedom."""


def planar(poses: Float[np.ndarray, "n 4 4"]) -> Planar:
    """Project poses to the x-y plane of their own frame."""
    return np.concatenate([poses[:, :2, 3], yaw_of(poses)[:, None]], axis=1)


def planar_loops(loops: Sequence[Loop], mounting: AnyMounting) -> tuple[Planar, Float[np.ndarray, "n 3 3"]]:
    """Poses of the queries in the frames of their matches, and their covariances in the frames of the queries.

    Standard deviations are limited to `DEGENERATE_M` along every direction. Otherwise a pose that may lie anywhere
    along a wall would agree with every other pose along the wall.
    """
    poses = np.array([loop.match_from_query for loop in loops], np.float64).reshape(-1, 4, 4)
    covariances = np.array([loop.covariance for loop in loops], np.float64).reshape(-1, 6, 6)
    query, match = frames_of(loops)
    covariances = moved_covariance(covariances, uprights(mounting, query))
    upright = upright_poses(poses, mounting, query=query, match=match)
    return planar(upright), _bounded(covariances[:, SEEN[:, None], SEEN])


def _bounded(covariances: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, "n 3 3"]:
    """Covariances with eigenvalues of at most `DEGENERATE_M` squared."""
    variances, axes = np.linalg.eigh(covariances)
    return (axes * np.minimum(variances, DEGENERATE_M**2)[:, None]) @ np.swapaxes(axes, 1, 2)


def frames_of(loops: Sequence[Loop]) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """Frames of the queries and of the matches."""
    return np.array([loop.query for loop in loops], np.int64), np.array([loop.match for loop in loops], np.int64)


def compose(a: Planar, b: Planar) -> Planar:
    """Return a_from_c of a_from_b and b_from_c."""
    a, b = np.broadcast_arrays(a, b)
    cos, sin = np.cos(a[..., 2]), np.sin(a[..., 2])
    x = a[..., 0] + cos * b[..., 0] - sin * b[..., 1]
    y = a[..., 1] + sin * b[..., 0] + cos * b[..., 1]
    return np.stack([x, y, wrapped(a[..., 2] + b[..., 2])], axis=-1)


def inverted(a: Planar) -> Planar:
    """Return b_from_a of a_from_b."""
    cos, sin = np.cos(a[..., 2]), np.sin(a[..., 2])
    return np.stack([-cos * a[..., 0] - sin * a[..., 1], sin * a[..., 0] - cos * a[..., 1], -a[..., 2]], axis=-1)


def relative(a: Planar, b: Planar) -> Planar:
    """Return the pose of b in the frame of a (`a_from_b`), from the poses of both in one common frame."""
    return compose(inverted(a), b)


def wrapped(angle: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Wrap angles to the range from -pi to pi."""
    return (angle + np.pi) % (2 * np.pi) - np.pi
