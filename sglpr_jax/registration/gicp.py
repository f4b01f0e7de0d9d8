"""Registration of two scans in 6 degrees of freedom: GICP, and KISS-Matcher (extra `slam`) for a first guess.

Neither method detects whether the scans show one place. If GICP starts 3 m off along a road, its result is 3 m off,
too. The overlap shows such errors. It is the share of the space of one scan that the other scan fills, too.
"""

import importlib.util
from dataclasses import dataclass
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from sglpr_jax.registration.covariance import NEIGHBOURS, matched_points, registration_covariance
from sglpr_jax.se3 import transformed


@dataclass(frozen=True)
class RegistrationConfig:
    """Settings of the registration of two scans."""

    voxel_m: float = 1.0
    """Edge of KISS-Matcher's voxels, in metres."""
    fine_voxel_m: float = 0.25
    """Edge of GICP's voxels, in metres."""
    max_apart_m: float = 1.0
    """Maximum distance of corresponding points in GICP, in metres."""
    iterations: int = 40
    """Maximum number of GICP iterations."""
    overlap_voxel_m: float = 1.0
    """Edge of the voxels of the overlap, in metres."""
    overlap_reach_m: float = 40.0
    """Maximum distance from both sensors of points that count in the overlap, in metres."""
    min_position_m: float = 0.002
    min_rotation_deg: float = 0.005
    """Standard deviations added to every covariance, in metres and degrees."""


class Registration(NamedTuple):
    """Pose of a query in the frame of a match, with covariance and overlap."""

    match_from_query: Float[np.ndarray, "4 4"]
    """Pose of the query's LiDAR in the frame of the match's LiDAR, in metres."""
    covariance: Float[np.ndarray, "6 6"]
    """Covariance of a small motion of the query in its own frame: x, y, z in metres, then rotations about x, y, z in
    radians."""
    overlap: float
    """Share of the space near both sensors that both scans fill, from 0 to 1."""


def register(
    query: Float32[np.ndarray, "n 3"],
    match: Float32[np.ndarray, "m 3"],
    *,
    initial: Float[np.ndarray, "4 4"] | None = None,
    initial_covariance: Float[np.ndarray, "6 6"] | None = None,
    config: RegistrationConfig = RegistrationConfig(),
) -> Registration:
    """Register the scan of a query to the scan of a match.

    Arguments:
      query: Points of the query in the LiDAR frame, in metres.
      match: Points of the match in the LiDAR frame, in metres.
      initial: First guess of `match_from_query`, within a metre and a few degrees. Without it KISS-Matcher computes
        one, which takes half a second.
      initial_covariance: Covariance of the first guess, of a small motion of the query in its own frame. The result
        keeps it along directions in which the scans can slide on each other, as in a tunnel.
      config: Settings of the registration.

    Raises:
      ImportError: If small-gicp or, without `initial`, KISS-Matcher is not installed.
      ValueError: If a scan has fewer than 100 finite points.

    Example:
      found = register(recording.points(52), recording.points(4501))
      found.overlap >= 0.6  # it is a loop
    """
    gicp = _library("small_gicp")
    query, match = _finite(query, "query"), _finite(match, "match")
    initial = coarse_pose(query, match, voxel_m=config.voxel_m) if initial is None else initial
    target, tree = _preprocessed(match, config)
    source, _ = _preprocessed(query, config)
    found = gicp.align(
        target,
        source,
        tree,
        init_T_target_source=np.asarray(initial, np.float64),
        registration_type="GICP",
        max_correspondence_distance=config.max_apart_m,
        max_iterations=config.iterations,
    )
    pose = np.asarray(found.T_target_source)
    order = np.array([3, 4, 5, 0, 1, 2])  # small_gicp puts rotation first
    information = np.asarray(found.H)[order][:, order]
    matched = matched_points(target, tree, source, pose, max_apart_m=config.max_apart_m)
    covariance = registration_covariance(information, matched, pose, initial_covariance)
    least = np.repeat([config.min_position_m, np.radians(config.min_rotation_deg)], 3) ** 2
    return Registration(pose, covariance + np.diag(least), overlap(query, match, pose, config=config))


def coarse_pose(
    query: Float32[np.ndarray, "n 3"], match: Float32[np.ndarray, "m 3"], *, voxel_m: float = 1.0
) -> Float[np.ndarray, "4 4"]:
    """Estimate `match_from_query` with KISS-Matcher, without a first guess. Raises ImportError without extra `slam`."""
    matcher = _library("kiss_matcher")
    found = matcher.KISSMatcher(matcher.KISSMatcherConfig(voxel_m)).estimate(query, match)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = found.rotation, found.translation
    return pose


def overlap(
    query: Float[np.ndarray, "n 3"],
    match: Float[np.ndarray, "m 3"],
    match_from_query: Float[np.ndarray, "4 4"],
    *,
    config: RegistrationConfig = RegistrationConfig(),
) -> float:
    """Number of voxels that both scans fill, divided by the number that the smaller scan fills, near both sensors."""
    moved = transformed(match_from_query, query)
    sensors = np.stack([np.zeros(3), match_from_query[:3, 3]])
    ours, theirs = (_voxels(cloud[_near(cloud, sensors, config)], config) for cloud in (moved, match))
    fewer = min(len(ours), len(theirs))
    return len(np.intersect1d(ours, theirs, assume_unique=True)) / fewer if fewer else 0.0


def _near(
    cloud: Float[np.ndarray, "n 3"], sensors: Float[np.ndarray, "2 3"], config: RegistrationConfig
) -> Bool[np.ndarray, " n"]:
    return np.all([np.linalg.norm(cloud - sensor, axis=1) < config.overlap_reach_m for sensor in sensors], axis=0)


def _voxels(cloud: Float[np.ndarray, "n 3"], config: RegistrationConfig) -> Int[np.ndarray, " v"]:
    """Occupied voxels, one number each."""
    side = 2 * int(config.overlap_reach_m / config.overlap_voxel_m) + 4
    x, y, z = np.floor(cloud / config.overlap_voxel_m).astype(np.int64).T + side // 2
    return np.unique((z * side + y) * side + x)


def _preprocessed(cloud: Float32[np.ndarray, "n 3"], config: RegistrationConfig) -> tuple[Any, Any]:
    """Downsampled cloud with the covariances of its surface, and its search tree."""
    points, size = cloud.astype(np.float64), config.fine_voxel_m
    return _library("small_gicp").preprocess_points(points, downsampling_resolution=size, num_neighbors=NEIGHBOURS)


def _finite(points: Float32[np.ndarray, "n 3"], name: str) -> Float32[np.ndarray, "n 3"]:
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < 100:
        raise ValueError(f"expected a {name} of 100 finite points or more to register, found {len(points)}")
    return points


def is_installed() -> bool:
    """Whether small-gicp is installed, which registers scans with a first guess."""
    return importlib.util.find_spec("small_gicp") is not None


def check_installed() -> None:
    """Raise ImportError if small-gicp is not installed, before any long work starts."""
    _library("small_gicp")


def _library(name: str) -> ModuleType:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ImportError(
            f"registration of scans needs {name.replace('_', '-')}: pip install 'sglpr-jax[slam]'"
        ) from error
