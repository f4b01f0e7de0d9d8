"""Memory and processor time of `LoopDetector` on a long drive, without image comparisons and without the network.

    python -m benchmarks.speed.long_drive --odometry

The vehicle drives the same circle again and again. Descriptors are random, images come from a few simulated scans, and
the poses that image comparisons would find are the true ones. Only the timed frames close loops.
"""

import dataclasses
import gc
import itertools
import sys
import time
from collections.abc import Iterator, Sequence
from types import FunctionType, ModuleType
from typing import Any

import numpy as np
import tyro
from jaxtyping import Float32, UInt8
from rich.console import Console
from rich.table import Table

import sglpr_jax
from sglpr_jax.loops.candidates import CandidateFinder
from sglpr_jax.loops.comparison import NO_FITS, Candidate, Comparer, Fits, Query, Stored
from sglpr_jax.loops.config import DetectorConfig
from sglpr_jax.loops.detector import LoopDetector
from sglpr_jax.loops.keyframes import Seen, square_image
from sglpr_jax.loops.probability import Evidence
from sglpr_jax.odometry.bev_odometry import Link
from sglpr_jax.registration.bev_alignment import Alignment
from sglpr_jax.registration.bev_search import Peak
from sglpr_jax.se3 import inverse, transform, yaw_of
from sglpr_jax.sim.recording import simulate_recording
from sglpr_jax.sim.sensor import HDL64E

STEP_S = 0.1
"""Time between two frames, in seconds."""
STEP_M = 1.0
"""Distance between two frames, in metres."""
IMAGES = 8
"""Number of different images."""


def main(
    *,
    frames: Sequence[int] = (1_000, 10_000, 20_000, 50_000, 100_000),
    lap: int = 2_000,
    window: int = 500,
    odometry: bool = False,
    weights: str = "circular",
    detector: DetectorConfig = DetectorConfig(),
) -> None:
    """Print bytes and milliseconds a frame after some numbers of frames.

    Args:
        frames: numbers of frames at which memory and time are measured.
        lap: frames of a lap, 1 m apart.
        window: frames over which the time is averaged.
        odometry: add poses with the frames.
        weights: model whose descriptors have the same width.
        detector: settings of the detector.
    """
    found = LoopDetector(sglpr_jax.load(weights), config=detector)
    drive = Drive(lap, found.finder.index.width)
    found.finder = WithoutImages(found.finder, drive)
    table = Table("frames", "MB", "bytes a frame", "ms a frame", "loops")
    before = held_bytes(found)
    for count, seconds in measured(found, drive, frames, window, odometry=odometry):
        held = held_bytes(found) - before
        values = (
            f"{count:,}",
            f"{held / 1e6:.0f}",
            f"{held / count:,.0f}",
            f"{1e3 * seconds:.2f}",
            f"{len(found.loops):,}",
        )
        table.add_row(*values)
    Console(width=100).print(table)


@dataclasses.dataclass
class Drive:
    """A circle of `lap` frames with a descriptor for each place."""

    lap: int
    width: int
    closes: bool = True
    """Whether the next frames have a candidate."""

    def __post_init__(self):
        self._rng = np.random.default_rng(0)
        self._places = self._rng.normal(size=(self.lap, self.width)).astype(np.float32)
        records = simulate_recording("08", scans=IMAGES, sensor=dataclasses.replace(HDL64E, azimuth_steps=600), seed=3)
        self._images: list[UInt8[np.ndarray, "n n"]] = [
            square_image(records.record(i, labels=False)) for i in range(IMAGES)
        ]

    def pose(self, frame: int) -> np.ndarray:
        """Pose of a frame, 4 x 4, in metres."""
        angle, radius = 2 * np.pi * frame / self.lap, STEP_M * self.lap / (2 * np.pi)
        return transform(radius * np.cos(angle), radius * np.sin(angle), angle + np.pi / 2)

    def seen(self, frame: int) -> Seen:
        """Descriptor of length 1, near to those of the same place, and an image of its own memory."""
        drawn: Float32[np.ndarray, " d"] = self._places[frame % self.lap] + 0.1 * self._rng.normal(size=self.width)
        return Seen((drawn / np.linalg.norm(drawn)).astype(np.float32), self._images[frame % IMAGES].copy(), None)


class _ByTruePose(Comparer):
    """Comparison of which the nearest scan is the result, at its true pose."""

    drive: Drive

    def __init__(self, known: Comparer, drive: Drive):
        vars(self).update(vars(known))
        self.__dict__["drive"] = drive

    def compare(self, query: Query, searched: Stored, *others: Stored, possible: Any = None) -> Fits:
        rows = searched.nearest(query.descriptor, 3, self.possible(searched.frames, query.frame))
        if not len(rows) or not self.drive.closes:
            return NO_FITS
        match = int(searched.frames[rows[0]])
        return Fits(np.array([match]), Peak(*(values[None] for values in peak(self.drive, query.frame, match))))

    def candidate(self, query: Query, fits: Fits, row: int, image_of: Any) -> Candidate:
        one = fits.peaks.one(row)
        values: Any = (one.x, one.y, one.yaw, np.diag([0.05, 0.05, 0.005]) ** 2, 0.9, 0.3)
        return Candidate(query.frame, int(fits.frames[row]), Alignment(*values), Evidence.of(0.3, 0.1, 0.5, 2.0))


class WithoutImages(CandidateFinder):
    """A finder whose image comparisons give the true pose at once."""

    def __init__(self, finder: CandidateFinder, drive: Drive):
        vars(self).update(vars(finder))
        self._drive = drive

    @property
    def comparer(self) -> Comparer:
        return _ByTruePose(super().comparer, self._drive)

    def _link(self, query: Query | None, clock: float) -> Link | None:
        if not len(self):
            return None
        found = peak(self._drive, len(self), self.motion.keyframe)
        x, y, yaw, correlation, second = map(np.asarray, found)
        return Link(x, y, yaw, correlation, second, np.asarray(0.1))


def peak(drive: Drive, query: int, match: int) -> Peak:
    """The pose of a query in the frame of its match."""
    moved = inverse(drive.pose(match)) @ drive.pose(query)
    return Peak(*map(np.asarray, (moved[0, 3], moved[1, 3], yaw_of(moved), 0.9, 0.3)))


def measured(
    detector: LoopDetector, drive: Drive, frames: Sequence[int], window: int, *, odometry: bool
) -> Iterator[tuple[int, float]]:
    """Add frames. Yields each number in `frames`, and the mean processor seconds of the last `window` frames."""
    for start, end in itertools.pairwise([0, *frames]):
        begin = 0.0
        for frame in range(start, end):
            drive.closes = frame >= end - window
            if frame == max(end - window, start):
                begin = time.process_time()
            pose = drive.pose(frame) if odometry else None
            detector.add_seen(drive.seen(frame), time=STEP_S * frame, odometry=pose)
        yield end, (time.process_time() - begin) / min(window, end - start)


def held_bytes(root: object) -> int:
    """Bytes of an object and of all that it refers to, without functions, modules and classes."""
    seen, left, total = {id(root)}, [root], 0
    while left:
        one = left.pop()
        total += sys.getsizeof(one)
        others = [one.base] if isinstance(one, np.ndarray) else gc.get_referents(one)
        for other in others:
            if id(other) not in seen and not isinstance(other, type | ModuleType | FunctionType):
                seen.add(id(other))
                left.append(other)
    return total


if __name__ == "__main__":
    tyro.cli(main)
