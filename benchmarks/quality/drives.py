"""The drives of `repeating_scans.py`, and how each of their scans compares with those that may show its place.

The comparisons take most of the time of a search and do not depend on the model of the probability. They are kept
beside the drives, in `compared/`, for the same settings of the finder; delete the folder after a change of its code.
"""

import dataclasses
import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from benchmarks.quality.loops import drifted
from sglpr_jax.data.recording import Record
from sglpr_jax.data.scaled import scaled_poses
from sglpr_jax.files import replacing
from sglpr_jax.loops.candidates import CandidateFinder, Compared
from sglpr_jax.loops.checkpoint import columns, compared_of
from sglpr_jax.loops.config import DetectorConfig
from sglpr_jax.loops.keyframes import Seen
from sglpr_jax.models.params import Params
from sglpr_jax.se3 import inverse, yaw_of

Odometry = Literal["none", "exact", "drifting"]
RIGHT, WRONG = (1.5, 6.0), (3.0, 15.0)
"""Largest errors of a right pose, and smallest errors of a wrong one, in metres and degrees."""
STOREY_M, SLOPE = 1.6, 0.3
"""Difference in height of scans on different storeys, in metres, and steepest slope between scans of one place."""


class RenderedDrive(NamedTuple):
    """One file."""

    name: str
    seen: Sequence[Seen]
    world_from_lidar: Float[np.ndarray, "n 4 4"]
    times: Float[np.ndarray, " n"]
    other_m: float
    """Frames farther apart than this show different places."""
    about: dict[str, str]
    """Scenery, revisit, sensor and seed."""
    scale: int = 1
    """Factor that all lengths, also those of the poses, were multiplied by."""

    def odometry(self, kind: Odometry) -> Float[np.ndarray, "n 4 4"] | None:
        """The true poses, the same with drift (`loops.drifted`), or None."""
        if kind == "none":
            return None
        poses = self.world_from_lidar
        if kind == "exact":
            return poses
        real = scaled_poses(poses, 1 / self.scale)
        return scaled_poses(drifted(real, seed=int(self.about["seed"])), self.scale)


def read(path: Path, params: Params | None = None) -> RenderedDrive:
    """Read a drive. `params` describe its images anew; without them descriptors are those of the file."""
    with np.load(path) as file:
        images, descriptors, poses, times, other_m = (
            file[name] for name in ("images", "descriptors", "world_from_lidar", "times", "other_m")
        )
        scale = int(file["scale"]) if "scale" in file else 1
        about = {name: str(file[name]) for name in ("scenery", "revisit", "sensor", "seed")}
    if params is None:
        seen = [Seen(descriptor, image, None) for descriptor, image in zip(descriptors, images, strict=True)]
    else:
        finder = CandidateFinder(params)
        seen = [finder.seen(Record(image=image)) for image in images]
    return RenderedDrive(path.stem, seen, scaled_poses(poses, scale), times, scale * float(other_m), about, scale)


def finder_of(params: Params) -> CandidateFinder:
    """An empty finder with the settings of the loop detector. It needs no model of the probability."""
    return CandidateFinder(params, keyframe_m=DetectorConfig.keyframe_m)


def compared(
    drive: RenderedDrive, params: Params, folder: Path, *, odometry: Odometry = "none", breaks: bool = False
) -> list[Compared]:
    """What the finder makes of each scan; read from the folder where it is kept.

    With `breaks`, the motion is unknown in the middle of the drive.
    """
    finder = finder_of(params)
    path = folder / f"{drive.name}-{_settings(finder, odometry)}{'-broken' * breaks}.npz"
    if path.exists():
        with np.load(path) as file:
            return compared_of(dict(file))
    poses = drive.odometry(odometry)
    found = []
    for i, (seen, time) in enumerate(zip(drive.seen, drive.times.tolist(), strict=True)):
        pose = None if poses is None else poses[i]
        finder.add_seen(seen, time=time, odometry=pose, continues=not (breaks and i == len(drive.seen) // 2))
        found.append(finder.compared)
    kept = columns(found)
    path.parent.mkdir(exist_ok=True, parents=True)
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **kept)
    return compared_of(kept)


def distances(pairs: Sequence[tuple[int, int]], poses: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, " k"]:
    """Metres between the scans of each pair."""
    frames = np.array(pairs, np.int64).reshape(-1, 2)
    return np.linalg.norm(poses[frames[:, 0], :3, 3] - poses[frames[:, 1], :3, 3], axis=1)


class PoseErrors(NamedTuple):
    """Errors of pairs against the true poses, one number for each pair."""

    metres: Float[np.ndarray, " k"]
    """In the plane of the match."""
    degrees: Float[np.ndarray, " k"]
    """Of the heading."""
    storey_m: Float[np.ndarray, " k"]
    """Difference in height between the scans, as far as it exceeds a slope of `SLOPE` between them."""

    @property
    def right(self) -> Bool[np.ndarray, " k"]:
        """Whether each pose is right."""
        return (self.metres <= RIGHT[0]) & (self.degrees <= RIGHT[1]) & (self.storey_m <= STOREY_M)

    @property
    def wrong(self) -> Bool[np.ndarray, " k"]:
        """Whether each pose is certainly wrong. Poses between right and wrong are neither."""
        return (self.metres > WRONG[0]) | (self.degrees > WRONG[1]) | (self.storey_m > STOREY_M)


def pose_errors(
    pairs: Sequence[tuple[int, int]],
    match_from_query: Float[np.ndarray, "k 4 4"],
    world_from_lidar: Float[np.ndarray, "n 4 4"],
) -> PoseErrors:
    """Errors of the poses of pairs (query, match)."""
    frames = np.array(pairs, np.int64).reshape(-1, 2)
    query, match = world_from_lidar[frames[:, 0]], world_from_lidar[frames[:, 1]]
    true, found = inverse(match) @ query, np.reshape(match_from_query, (-1, 4, 4))
    apart = np.linalg.norm((found - true)[:, :2, 3], axis=1)
    turned = np.degrees(np.abs((yaw_of(found) - yaw_of(true) + np.pi) % (2 * np.pi) - np.pi))
    up = np.abs(query[:, 2, 3] - match[:, 2, 3]) - SLOPE * np.linalg.norm((query - match)[:, :2, 3], axis=1)
    return PoseErrors(apart, turned, up)


def _settings(finder: CandidateFinder, odometry: Odometry) -> str:
    """A name for all that decides the comparisons."""
    parts = [finder.config, finder.verification, finder.motion_drift if odometry == "none" else finder.drift]
    about = json.dumps([finder.index.weights_hash, odometry, *map(dataclasses.asdict, parts)])
    return hashlib.sha256(about.encode()).hexdigest()[:16]
