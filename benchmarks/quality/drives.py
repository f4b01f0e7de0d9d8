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
from jaxtyping import Float

from benchmarks.quality.loops import drifted
from sglpr_jax.data.record import Record
from sglpr_jax.data.scaled import scaled_poses
from sglpr_jax.files import replacing
from sglpr_jax.loops.candidates import CandidateFinder, Compared
from sglpr_jax.loops.seen import Seen
from sglpr_jax.loops.unfinished import columns, compared_of
from sglpr_jax.models.params import Params

Odometry = Literal["none", "exact", "drifting"]


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


def compared(
    drive: RenderedDrive, finder: CandidateFinder, folder: Path, *, odometry: Odometry = "none"
) -> list[Compared]:
    """What a finder, an empty one, makes of each scan; read from the folder where it is kept."""
    path = folder / f"{drive.name}-{_settings(finder, odometry)}.npz"
    if path.exists():
        with np.load(path) as file:
            return compared_of(dict(file), range(len(drive.seen)))
    poses = drive.odometry(odometry)
    found = []
    for i, (seen, time) in enumerate(zip(drive.seen, drive.times.tolist(), strict=True)):
        pose = None if poses is None else poses[i]
        finder.add_seen(seen, time=time, odometry=pose)
        found.append(finder.compared)
    kept = columns(found)
    path.parent.mkdir(exist_ok=True, parents=True)
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **kept)
    return compared_of(kept, range(len(drive.seen)))


def distances(pairs: Sequence[tuple[int, int]], poses: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, " k"]:
    """Metres between the scans of each pair."""
    frames = np.array(pairs, np.int64).reshape(-1, 2)
    return np.linalg.norm(poses[frames[:, 0], :3, 3] - poses[frames[:, 1], :3, 3], axis=1)


def _settings(finder: CandidateFinder, odometry: Odometry) -> str:
    """A name for all that decides the comparisons."""
    parts = [finder.config, finder.verification, *([] if odometry == "none" else [finder.drift])]
    about = json.dumps([finder.index.weights_hash, odometry, *map(dataclasses.asdict, parts)])
    return hashlib.sha256(about.encode()).hexdigest()[:16]
