"""Described drives in files: what the loop detector keeps of each scan, so that a search need not render them again.

Each file has these arrays of n scans:

    descriptors (n, 256) float32, images (n, h, w) uint8, world_from_lidar (n, 4, 4) in metres, times (n,) in seconds
    scale: factor for the lengths of the images; and facts of the drive, such as its world and seed
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from benchmarks.drives import Odometry, odometry_of, recording_of, revisited
from sglpr_jax.data.choices import Scale
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scaled import scaled, scaled_poses
from sglpr_jax.data.scan import Scan
from sglpr_jax.files import replacing
from sglpr_jax.loops.candidates import CandidateSearch
from sglpr_jax.loops.detector import LoopDetector
from sglpr_jax.loops.keyframes import Keyframe, describe_scan
from sglpr_jax.models.params import Params
from sglpr_jax.se3 import travelled
from sglpr_jax.sim.recording import SimulatedRecording

REPEATING_M, WAY_M = 3.0, 30.0
"""Where places repeat, a revisit is within the first distance after this length of path, in metres."""


class DescribedDrive(NamedTuple):
    """A drive as its file holds it."""

    path: Path
    keyframes: list[Keyframe]
    world_from_lidar: Float[np.ndarray, "n 4 4"]
    """Poses, with lengths multiplied by `scale`."""
    times: Float[np.ndarray, " n"]
    facts: dict[str, str]
    """World, route, seed, sensor and carrier, or others."""
    scale: int

    def odometry(self, kind: Odometry, seed: int) -> Float[np.ndarray, "n 4 4"] | None:
        """The true poses, the same with drift, or None."""
        odometry = odometry_of(kind, scaled_poses(self.world_from_lidar, 1 / self.scale), seed=seed)
        return None if odometry is None else scaled_poses(odometry, self.scale)

    @property
    def revisits(self) -> Bool[np.ndarray, " n"]:
        """Which scans come within 3 m of one from which at least 30 m were travelled."""
        poses, scale = self.world_from_lidar, self.scale
        return revisited(poses[:, :3, 3], travelled(poses), near_m=REPEATING_M * scale, apart=WAY_M * scale)

    @property
    def recording(self) -> Recording:
        """The recording of the images."""
        return recording_of(self.path.stem, [Scan(image=one.image) for one in self.keyframes], self.times)


def store(path: Path, drive: SimulatedRecording, params: Params, *, scale: Scale = 1, **facts: Any) -> None:
    """Render and describe a drive, and write its file."""
    recording = scaled(drive, scale)
    keyframes = [describe_scan(params, recording.scan(i, labels=False)) for i in range(len(recording))]
    arrays = {
        "descriptors": np.stack([one.descriptor for one in keyframes]),
        "images": np.stack([one.image for one in keyframes]),
        "world_from_lidar": drive.poses.world_from_lidar,
        "times": drive.poses.times,
    }
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, scale=np.array(scale), **arrays, **facts)


def read(path: Path) -> DescribedDrive:
    """Read a drive."""
    with np.load(path) as file:
        scale, facts = int(file["scale"]), {name: str(file[name]) for name in file.files if not file[name].ndim}
        keyframes = [Keyframe(*pair, None) for pair in zip(file["descriptors"], file["images"], strict=True)]
        poses = scaled_poses(file["world_from_lidar"], scale)
        return DescribedDrive(path, keyframes, poses, file["times"], facts, scale)


def read_all(folder: Path, worlds: Sequence[str] = (), sensors: Sequence[str] = ()) -> Iterator[DescribedDrive]:
    """The drives of a folder through some worlds and by some sensors, or through and by all if none is named."""
    for path in sorted(folder.glob("*.npz")):
        drive = read(path)
        if drive.facts["world"] in (worlds or [drive.facts["world"]]) and drive.facts["sensor"] in (
            sensors or [drive.facts["sensor"]]
        ):
            yield drive


def replay(
    search: LoopDetector | CandidateSearch,
    drive: DescribedDrive,
    odometry: Float[np.ndarray, "n 4 4"] | None = None,
    *,
    breaks: bool = False,
) -> Iterator[list[Any]]:
    """Add the scans of a drive to a search, and yield what it returns. With `breaks`, the motion is unknown in the
    middle."""
    for i, keyframe in enumerate(drive.keyframes):
        pose = None if odometry is None else odometry[i]
        continues = not (breaks and i == len(drive.keyframes) // 2)
        yield search.add_keyframe(keyframe, time=float(drive.times[i]), odometry=pose, continues=continues)
