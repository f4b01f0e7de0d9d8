"""Measures the estimate of a sensor's height and tilt on simulated drives, and what it is worth to a model.

    python -m benchmarks.quality.mounting --scans 96 --routes 00 06

For each sensor, height and pitch: the errors of the height found from single scans (median and 95 %), the error of the
whole recording's, and Recall@1 (5 m, at least 10 scans older) of the descriptors without the estimate and with it.
"""

import dataclasses
import itertools
from dataclasses import dataclass

import jax
import numpy as np
import tyro

import sglpr_jax
from sglpr_jax.data.gravity import mounted
from sglpr_jax.data.mounting import estimate_mounting
from sglpr_jax.data.recording import Recording
from sglpr_jax.se3 import distances
from sglpr_jax.sim.recording import simulate_recording
from sglpr_jax.sim.sensor import SENSORS

APART_M = 5.0
OLDER = 10


@dataclass(frozen=True)
class Command:
    """Which simulated drives."""

    scans: int = 96
    """Of each drive."""
    routes: tuple[str, ...] = ("00", "06")
    sensors: tuple[str, ...] = ("hdl64e", "vlp16")
    heights: tuple[float, ...] = (0.5, 1.0, 1.73, 2.5)
    """Metres above the road."""
    pitches: tuple[float, ...] = (0.0, 10.0)
    """Degrees by which the sensor looks down."""
    weights: str = "circular"
    azimuth_steps: int = 600
    seed: int = 11


def pitched(recording: Recording, degrees: float) -> Recording:
    """The recording of a sensor that looks down by so many degrees."""
    angle = np.radians(degrees)
    cos, sin = np.cos(angle), np.sin(angle)
    lidar_from_upright = np.array([[cos, 0, -sin], [0, 1, 0], [sin, 0, cos]])

    def read(path, labels, lasers):
        record = recording.read(path, None, False)
        return dataclasses.replace(record, points=(record.points @ lidar_from_upright.T).astype(np.float32))

    return dataclasses.replace(recording, read=read)


def recall_at_1(file: sglpr_jax.DescriptorFile) -> tuple[int, int]:
    """How many queries find a place within 5 m first among those that are older, and how many could."""
    apart = distances(file.positions[:, :2], file.positions[:, :2])
    unlike = distances(file.descriptors, file.descriptors)
    older = np.tri(len(file), k=-OLDER, dtype=bool)
    queries = ((apart <= APART_M) & older).any(axis=1)
    nearest = np.where(older, unlike, np.inf).argmin(axis=1)
    right = apart[np.arange(len(file)), nearest] <= APART_M
    return int((right & queries).sum()), int(queries.sum())


def measure(command: Command, sensor: str, height: float, pitch: float) -> str:
    """One row of the table."""
    lidar = dataclasses.replace(SENSORS[sensor], height_m=height, azimuth_steps=command.azimuth_steps)
    params = sglpr_jax.load(command.weights)
    errors, whole, before, after = [], [], np.zeros(2, int), np.zeros(2, int)
    for route in command.routes:
        drive = simulate_recording(route, scans=command.scans, sensor=lidar, seed=command.seed)
        points = {path: drive.read(path, None, False) for path in drive.paths}
        recording = pitched(dataclasses.replace(drive, read=lambda path, *_, points=points: points[path]), pitch)
        found = [estimate_mounting(recording.points(i)) for i in range(len(recording))]
        errors += [np.nan if mounting is None else mounting.height_m - height for mounting in found]
        levelled = mounted(recording, "estimate", known=False)
        whole += [np.nan if levelled.mounting is None else levelled.mounting.height_m - height]
        before += recall_at_1(sglpr_jax.embed(params, recording))
        after += recall_at_1(sglpr_jax.embed(params, levelled))
        jax.clear_caches()
    missing = int(np.isnan(errors).sum())
    middle, most = np.nanpercentile(np.abs(errors), [50, 95])
    recalls = " | ".join(f"{right / max(of, 1):.3f}" for right, of in (before, after))
    worst = np.nanmax(np.abs(whole))
    row = f"{sensor} | {height:g} | {pitch:g} | {middle:.3f} | {most:.3f} | {missing} of {len(errors)} | {worst:.3f}"
    return f"| {row} | {recalls} | {after[1]} |"


def main() -> None:
    """The entry point."""
    command = tyro.cli(Command)
    columns = ("sensor", "height m", "pitch", "error of a scan, median", "95 %", "no ground", "of the recording")
    print("| " + " | ".join((*columns, "Recall@1 as it is", "levelled", "queries")) + " |")
    print("|---" * 10 + "|")
    for sensor, height, pitch in itertools.product(command.sensors, command.heights, command.pitches):
        print(measure(command, sensor, height, pitch), flush=True)


if __name__ == "__main__":
    main()
