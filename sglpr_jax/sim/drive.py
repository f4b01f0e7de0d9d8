"""Where the vehicle goes: three routes through a street grid, each with the revisits that its namesake in KITTI has."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from sglpr_jax.sim.world import World

ROUTES = {
    # Around an L of three blocks and on for half the way again: same-direction revisits.
    "00": ((0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2), (0, 0), (2, 0), (2, 1), (1.5, 1)),
    # Around a row of three blocks, likewise.
    "05": ((0, 0), (3, 0), (3, 1), (0, 1), (0, 0), (3, 0), (3, 0.5)),
    # Out along two streets, around a block, and the two streets back: revisits in the opposite direction.
    "08": ((1, 0), (2, 0), (2, 3), (3, 3), (3, 2), (2, 2), (2, 0), (1, 0)),
}
"""The corners of every route as (street along y, street along x); 1.5 is midway between two. Scale 1: some 600 m."""
SCANS_PER_SCALE = 300
SPEED_MPS = 6.0
LANE_M = 0.9
"""How far right of the middle of the street the vehicle keeps; small, so that both directions lie within 3 m."""
SWAY_M = 0.3
CORNER_RADIUS_M = 4.5
STEP_M = 0.25


class Drive(NamedTuple):
    """Where the LiDAR was, and when."""

    world_from_lidar: np.ndarray  # (n, 4, 4) float64; x forward, y left, z up, metres
    times: np.ndarray  # (n,) seconds


def scale_of(scans: int) -> int:
    """How much larger than at scale 1 a route of `scans` scans is, so that scans lie some 2 m apart."""
    return max(1, round(scans / SCANS_PER_SCALE))


def streets_needed(name: str, scans: int) -> tuple[int, int]:
    """How many streets along y and along x the route needs, with a block of houses all around."""
    columns, rows = np.max(ROUTES[name], axis=0) * scale_of(scans)
    return int(columns) + 3, int(rows) + 3


def plan_drive(rng: np.random.Generator, name: str, world: World, *, scans: int, height_m: float) -> Drive:
    """Return `scans` poses along the route `name`, evenly spaced, driven at a constant speed.

    The path keeps to the right of the middle of the street and sways a little, differently on every visit.
    """
    nodes = np.array(ROUTES[name]) * scale_of(scans) + 1
    streets = world.streets_x, world.streets_y
    corners = np.stack([np.interp(n, np.arange(len(s)), s) for n, s in zip(nodes.T, streets, strict=True)], axis=1)
    path = _in_lane(rng, _resample(_rounded(corners), STEP_M))
    travelled = _travelled(path)
    at = np.linspace(0, travelled[-1], scans)
    x, y = (np.interp(at, travelled, axis) for axis in path.T)
    heading = np.unwrap(np.arctan2(*np.gradient(path, axis=0).T[::-1]))
    poses = _level_poses(x, y, np.full(scans, height_m), np.interp(at, travelled, heading))
    return Drive(poses, at / SPEED_MPS)


def _travelled(path: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
    return np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])


def _rounded(corners: Float[np.ndarray, "c 2"]) -> Float[np.ndarray, "n 2"]:
    """The way through `corners` with a quarter circle in place of every turn."""
    points = [corners[:1]]
    quarter = np.linspace(0, np.pi / 2, 30)[:, None]
    for before, corner, after in zip(corners[:-2], corners[1:-1], corners[2:], strict=True):
        arriving = (corner - before) / np.linalg.norm(corner - before)
        leaving = (after - corner) / np.linalg.norm(after - corner)
        centre = corner + CORNER_RADIUS_M * (leaving - arriving)
        points.append(centre + CORNER_RADIUS_M * (np.sin(quarter) * arriving - np.cos(quarter) * leaving))
    return np.concatenate([*points, corners[-1:]])


def _resample(path: Float[np.ndarray, "n 2"], step_m: float) -> Float[np.ndarray, "m 2"]:
    travelled = _travelled(path)
    at = np.linspace(0, travelled[-1], int(travelled[-1] / step_m) + 2)
    return np.stack([np.interp(at, travelled, axis) for axis in path.T], axis=1)


def _in_lane(rng: np.random.Generator, path: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """`path` moved to the right, with a slow sway."""
    wavelengths, phases = rng.uniform(60, 150, 3), rng.uniform(0, 2 * np.pi, 3)
    waves = np.sin(2 * np.pi * _travelled(path)[:, None] / wavelengths[None, :] + phases[None, :])
    offset = LANE_M + SWAY_M * waves.mean(axis=1)
    tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    return path + offset[:, None] * np.stack([tangent[:, 1], -tangent[:, 0]], axis=1)


def _level_poses(x: np.ndarray, y: np.ndarray, z: np.ndarray, yaw: np.ndarray) -> Float[np.ndarray, "n 4 4"]:
    poses = np.tile(np.eye(4), (len(yaw), 1, 1))
    cos, sin = np.cos(yaw), np.sin(yaw)
    poses[:, 0, 0], poses[:, 0, 1], poses[:, 1, 0], poses[:, 1, 1] = cos, -sin, sin, cos
    poses[:, :3, 3] = np.stack([x, y, z], axis=1)
    return poses
