"""Files of simulated drives with the descriptor and image of each scan, so that benchmarks render each drive once.

Each file has these arrays of n scans:

    descriptors (n, 256) float32, images (n, h, w) uint8, world_from_lidar (n, 4, 4) in metres, times (n,) in seconds
    scale: factor for all lengths in the images; and properties of the drive as texts, such as its world and seed
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from benchmarks.drives import Odometry, is_revisit, odometry_of, recording_of
from sglpr_jax.data.choices import Scale
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scaled import scaled, scaled_poses
from sglpr_jax.data.scan import Scan
from sglpr_jax.files import replacing
from sglpr_jax.loops.candidates import CandidateSearch
from sglpr_jax.loops.detector import LoopDetector
from sglpr_jax.loops.keyframes import Keyframe, describe_scan
from sglpr_jax.models.weights import Params
from sglpr_jax.se3 import travelled
from sglpr_jax.sim.recording import SimulatedRecording

REPEATING_M, WAY_M = 3.0, 30.0
"""In repeating sceneries, a revisit is within the first distance of a scan at least the second length before (m)."""


class DescribedDrive(NamedTuple):
    """A drive as its file holds it."""

    path: Path
    keyframes: list[Keyframe]
    world_from_lidar: Float[np.ndarray, "n 4 4"]
    """Poses, with lengths multiplied by `scale`."""
    times: Float[np.ndarray, " n"]
    facts: dict[str, str]
    """Properties of the drive by name, such as world, route, seed, sensor and carrier."""
    scale: int

    def odometry(self, kind: Odometry, seed: int) -> Float[np.ndarray, "n 4 4"] | None:
        """True poses if `kind` is "exact", true poses with drift if it is "drifting", or None. Lengths are scaled."""
        odometry = odometry_of(kind, scaled_poses(self.world_from_lidar, 1 / self.scale), seed=seed)
        return None if odometry is None else scaled_poses(odometry, self.scale)

    @property
    def revisits(self) -> Bool[np.ndarray, " n"]:
        """Whether each scan is within 3 m of an earlier scan, at least 30 m of path before."""
        poses, scale = self.world_from_lidar, self.scale
        return is_revisit(poses[:, :3, 3], travelled(poses), near_m=REPEATING_M * scale, min_progress=WAY_M * scale)

    @property
    def recording(self) -> Recording:
        """Recording whose scans are the stored images."""
        return recording_of(self.path.stem, [Scan(image=keyframe.image) for keyframe in self.keyframes], self.times)


def store(path: Path, drive: SimulatedRecording, params: Params, *, scale: Scale = 1, **facts: Any) -> None:
    """Renders and describes a drive, and writes its file."""
    recording = scaled(drive, scale)
    keyframes = [describe_scan(params, recording.scan(i, labels=False)) for i in range(len(recording))]
    arrays = {
        "descriptors": np.stack([keyframe.descriptor for keyframe in keyframes]),
        "images": np.stack([keyframe.image for keyframe in keyframes]),
        "world_from_lidar": drive.poses.world_from_lidar,
        "times": drive.poses.times,
    }
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, scale=np.array(scale), **arrays, **facts)


def read(path: Path) -> DescribedDrive:
    """Reads a file that `store` has written."""
    with np.load(path) as file:
        scale, facts = int(file["scale"]), {name: str(file[name]) for name in file.files if not file[name].ndim}
        keyframes = [Keyframe(*arrays, None) for arrays in zip(file["descriptors"], file["images"], strict=True)]
        poses = scaled_poses(file["world_from_lidar"], scale)
        return DescribedDrive(path, keyframes, poses, file["times"], facts, scale)


def read_all(folder: Path, worlds: Sequence[str] = (), sensors: Sequence[str] = ()) -> Iterator[DescribedDrive]:
    """Yields the drives of a folder whose world is in `worlds` and whose sensor is in `sensors`. Empty means any."""
    for path in sorted(folder.glob("*.npz")):
        drive = read(path)
        is_wanted_world = not worlds or drive.facts["world"] in worlds
        if is_wanted_world and (not sensors or drive.facts["sensor"] in sensors):
            yield drive


def replay(
    search: LoopDetector | CandidateSearch,
    drive: DescribedDrive,
    odometry: Float[np.ndarray, "n 4 4"] | None = None,
    *,
    breaks: bool = False,
) -> Iterator[list[Any]]:
    """Adds the keyframes of a drive to a search, one by one, and yields the results of `add_keyframe`.

    With `breaks`, the motion to the scan in the middle of the drive is unknown.
    """
    finder = search.finder if isinstance(search, LoopDetector) else search
    for i, keyframe in enumerate(drive.keyframes):
        pose = None if odometry is None else odometry[i]
        continues = not (breaks and i == len(drive.keyframes) // 2)
        when = {"time": float(drive.times[i]), "odometry": pose, "continues": continues}
        if finder.is_due(**when):
            yield search.add_keyframe(keyframe, **when)
        else:
            finder.skip()
