"""Loops of several rendered drives that follow each other, as if they were one long recording of one kind of place.

    python -m benchmarks.quality.repeating_scans --sceneries forest --scans 240 --seeds 23 24 --out build/forest
    python -m benchmarks.quality.many_drives build/forest/forest-*-vlp16-2[34].npz --further 0 25

The scans of the other drives compete with those of the true place. The motion is unknown between two drives. A loop is
wrong if its scans are of two drives or farther apart than `other_m`. For each value of `further` the table shows the
loops and how many of the revisits within 5 m have one. `--noise` makes the descriptors worse, as they are in real woods
where the nearest descriptor is right for a third of the revisits: the standard deviation of the length of what is added
to a descriptor of length 1.
"""

import dataclasses
import time
from pathlib import Path

import numpy as np
import tyro
from jaxtyping import Bool, Float
from rich.console import Console
from rich.table import Table

import sglpr_jax
from benchmarks.quality.drives import RenderedDrive, read
from benchmarks.quality.repeating import REVISIT_M, revisits
from sglpr_jax.loops.config import DetectorConfig
from sglpr_jax.loops.detector import LoopDetector

BREAK_S = 1000.0
"""Time between two drives."""
FAR_M = 10_000.0
"""Distance between the frames of two drives."""
NEAREST = (1, 3, 10, 25)


def main(
    drives: tyro.conf.Positional[tuple[Path, ...]], *, further: tuple[int, ...] = (0, 25), noise: float = 0.0
) -> None:
    """Search the drives, once for each value.

    Args:
        drives: files of `repeating_scans.py`.
        further: values of `CandidateConfig.further`.
        noise: length of the noise of the descriptors.
    """
    read_drives = [_noisy(read(path), noise) for path in drives]
    positions, times = _chained(read_drives)
    revisited = revisits(positions, times, REVISIT_M)
    print(f"{len(times)} scans of {len(drives)} drives, {revisited.sum()} revisits")
    for k, share in _retrieved(read_drives, positions, times, revisited).items():
        print(f"  true place among the {k} nearest descriptors: {share:.3f}")
    table = Table("further", "loops", "wrong", "recall", "ms a frame (processor)")
    for value in further:
        table.add_row(str(value), *_searched(read_drives, positions, times, revisited, value))
    Console().print(table)


def _noisy(drive: RenderedDrive, noise: float) -> RenderedDrive:
    """A drive with noise in its descriptors."""
    rng = np.random.default_rng(int(drive.about["seed"]))
    seen = []
    for one in drive.seen:
        moved = one.descriptor + noise * rng.normal(size=one.descriptor.shape) / np.sqrt(one.descriptor.size)
        seen.append(one._replace(descriptor=(moved / np.linalg.norm(moved)).astype(np.float32)))
    return drive._replace(seen=seen)


def _chained(drives: list[RenderedDrive]) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
    """Positions and times of all scans, the drives far from each other and one after the other."""
    positions, times, start = [], [], 0.0
    for k, drive in enumerate(drives):
        positions.append(drive.world_from_lidar[:, :3, 3] + np.array([k * FAR_M, 0, 0]))
        times.append(drive.times - drive.times[0] + start)
        start = times[-1][-1] + BREAK_S
    return np.concatenate(positions), np.concatenate(times)


def _retrieved(
    drives: list[RenderedDrive],
    positions: Float[np.ndarray, "n 3"],
    times: Float[np.ndarray, " n"],
    revisited: Bool[np.ndarray, " n"],
) -> dict[int, float]:
    """Share of the revisits whose place is among the nearest descriptors of scans 30 s older."""
    descriptors = np.stack([seen.descriptor for drive in drives for seen in drive.seen])
    found = dict.fromkeys(NEAREST, 0)
    for i in np.flatnonzero(revisited):
        old = times <= times[i] - 30
        order = np.argsort(np.linalg.norm(descriptors[old] - descriptors[i], axis=1))
        near = np.linalg.norm(positions[old][order] - positions[i], axis=1) < 2 * REVISIT_M
        for k in NEAREST:
            found[k] += bool(near[:k].any())
    return {k: count / max(revisited.sum(), 1) for k, count in found.items()}


def _searched(
    drives: list[RenderedDrive],
    positions: Float[np.ndarray, "n 3"],
    times: Float[np.ndarray, " n"],
    revisited: Bool[np.ndarray, " n"],
    further: int,
) -> tuple[str, ...]:
    """A row of the table."""
    config = DetectorConfig()
    config = dataclasses.replace(config, candidates=dataclasses.replace(config.candidates, further=further))
    detector = LoopDetector(sglpr_jax.load("sglpr"), config=config)
    seen = [one for drive in drives for one in drive.seen]
    begin = time.process_time()
    for one, when in zip(seen, times.tolist(), strict=True):
        detector.add_seen(one, time=when)
    cost = 1e3 * (time.process_time() - begin) / len(seen)
    pairs = np.array([(loop.query, loop.match) for loop in detector.loops], np.int64).reshape(-1, 2)
    apart = np.linalg.norm(positions[pairs[:, 0]] - positions[pairs[:, 1]], axis=1)
    right = apart <= drives[0].other_m
    recall = np.isin(np.flatnonzero(revisited), pairs[right, 0]).mean() if revisited.any() else np.nan
    return str(len(pairs)), str((~right).sum()), f"{recall:.3f}", f"{cost:.1f}"


if __name__ == "__main__":
    tyro.cli(main)
