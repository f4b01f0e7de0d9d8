"""Single scans and submaps on a street that is driven five times, in both directions and a lane aside."""

from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.distance import cdist

import sglpr_jax
from benchmarks.drives import drifted, lidar, on_disk
from benchmarks.table import Table
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scan_stream import only
from sglpr_jax.se3 import lengths_along
from sglpr_jax.sim.drive import PlanarPath, plan_path, shifted, timed
from sglpr_jax.sim.recording import drive_through
from sglpr_jax.sim.world import build_world

PASSES = {"map": 0.0, "opposite": 2.4, "same": 0.4, "opposite, aside": 3.5, "same, aside": 3.5}
"""Metres by which each pass is left of the first one. Every second pass drives back."""
ROUTE = "10"
"""Route of the first pass. It does not return to a place."""
SPEED_MPS, PAUSE_S = 8.0, 2.0
APART_M = 5.0
RIGHT_M = 5.0
FIRST_M = 20.0
"""Scans of the first metres of a pass are not scored, because their submaps are incomplete."""


class Drive(NamedTuple):
    """Scans of the five passes, with the number of the pass of each scan."""

    recording: Recording
    poses: Float[np.ndarray, "n 4 4"]
    passes: Int[np.ndarray, " n"]


def recall(
    *,
    sensors: tuple[str, ...] = ("vlp16", "os1-64", "hdl64e"),
    seeds: tuple[int, ...] = (601, 602),
    lengths_m: tuple[float, ...] = (0.0, 10.0),
    metres: int = 160,
    spacing_m: float = 2.0,
    azimuth_steps: int = 900,
    weights: str = "sglpr",
    out: Path = Path("build/submaps"),
) -> None:
    """Measure Recall@1 of single scans and of submaps. Prints a row for each sensor and length.

    The first pass is the map. A query is a scan of another pass. It is right if the nearest descriptor of the map is
    within 5 m. The odometry is 1 % too long and turns by one degree every 100 m. The scans are kept in `out`.

    Args:
        sensors: names of sensors.
        seeds: one town for each.
        lengths_m: lengths of the submaps; 0 is a single scan.
        metres: length of the street; a scan every metre.
        spacing_m: distance between the scored scans.
        azimuth_steps: firings of the sensor per turn, at most.
        weights: the model that describes the scans.
        out: folder of the scans.
    """
    params, table = sglpr_jax.load(weights), Table("sensor", "submap m", *list(PASSES)[1:])
    for sensor in sensors:
        drives = [rendered(sensor, seed, metres, azimuth_steps, out) for seed in seeds]
        for length_m in lengths_m:
            recalls = _recalls(drives, params, length_m, max(1, round(spacing_m)))
            table.add(sensor, f"{length_m:g}", *(f"{value:.3f}" for value in recalls))


def _recalls(drives: list[Drive], params: sglpr_jax.Params, length_m: float, every: int) -> list[float]:
    """Recall@1 of each pass after the first. Only every `every`-th scan is scored."""
    of_drives = []
    for town, drive in enumerate(drives):
        recording = submaps_of_passes(drive, length_m, seed=town)
        rows = [i for i in scored(drive) if i % every == 0]
        file = sglpr_jax.embed(params, only(recording, rows), on_bad_scan=lambda scan, error: None)
        descriptors = np.full((len(rows), file.descriptors.shape[1]), np.inf)  # inf for empty scans
        descriptors[np.isin([recording.ids[i] for i in rows], file.ids)] = file.descriptors
        of_drives.append((descriptors, drive.poses[rows, :3, 3] + [1e5 * town, 0, 0], drive.passes[rows]))
    descriptors, positions, passes = (np.concatenate(values) for values in zip(*of_drives, strict=True))
    is_described = np.isfinite(descriptors).all(axis=1)
    descriptors = np.where(is_described[:, None], descriptors, 0.0)
    mapped = (passes == 0) & is_described
    nearest = cdist(descriptors, descriptors[mapped]).argmin(axis=1)
    apart = cdist(positions, positions[mapped])
    right = (apart[np.arange(len(apart)), nearest] <= RIGHT_M) & is_described
    answerable = apart.min(axis=1) <= RIGHT_M
    return [float(right[answerable & (passes == number)].mean()) for number in range(1, len(PASSES))]


def scored(drive: Drive) -> list[int]:
    """Rows of the scans that are at least FIRST_M metres after the start of their pass."""
    first_of_pass = np.searchsorted(drive.passes, drive.passes)
    steps = np.diff(drive.poses[:, :3, 3], axis=0, prepend=drive.poses[:1, :3, 3])
    length_m = np.linalg.norm(steps, axis=1).cumsum()
    return np.flatnonzero(length_m - length_m[first_of_pass] >= FIRST_M).tolist()


def submaps_of_passes(drive: Drive, length_m: float, *, seed: int) -> Recording:
    """Recording with submaps by drifting odometry. Passes are 10 km apart in height, so that no submap spans two."""
    odometry = drifted(drive.poses, seed=seed, turn_deg=1.0)
    odometry[:, 2, 3] += 1e4 * drive.passes
    return sglpr_jax.submaps(drive.recording, odometry, length_m=length_m)


def rendered(sensor: str, seed: int, metres: int, azimuth_steps: int, folder: Path) -> Drive:
    """The five passes, with a scan every metre in a folder (`on_disk`)."""
    xy = plan_path(np.random.default_rng((seed, 5)), ROUTE, scans=600, rate_hz=10.0).xy
    even_m, length_m = np.arange(0.0, metres, 0.5), lengths_along(xy)  # a point every half metre
    line = np.stack([np.interp(even_m, length_m, axis) for axis in xy.T], axis=1)
    rng, paths, clock = np.random.default_rng((seed, 6)), [], 0.0
    for number, left_m in enumerate(PASSES.values()):
        pass_line = shifted(line, left_m)
        path = timed(rng, pass_line[::-1] if number % 2 else pass_line, free_mps=SPEED_MPS, poses=metres)
        paths.append(path._replace(times=path.times + clock))
        clock = paths[-1].times[-1] + PAUSE_S
    all_passes = PlanarPath(*(np.concatenate(arrays) for arrays in zip(*paths, strict=True)))
    starts = np.cumsum([0, *(len(path.times) for path in paths[:-1])])
    poses_per_scan = [len(path.times) // metres for path in paths]
    rows = np.concatenate([start + np.arange(metres) * k for start, k in zip(starts, poses_per_scan, strict=True)])
    recording = drive_through(
        build_world((seed, 7), all_passes.xy, all_passes.times),
        all_passes,
        rows,
        name=f"{sensor}-{seed}",
        sensor=lidar(sensor, azimuth_steps),
        key=jax.random.key(seed),
        rng=np.random.default_rng((seed, 8)),
    )
    stored = on_disk(recording, folder / f"{sensor}-{seed}-{metres}-{azimuth_steps}")
    return Drive(stored, recording.poses.world_from_lidar, np.repeat(np.arange(len(PASSES)), metres))
