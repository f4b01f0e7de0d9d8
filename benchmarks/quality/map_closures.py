"""Loops of simulated drives by MapClosures and by ours, side by side, from nothing but scans: odometry is kiss-icp's.

    python -m benchmarks.quality.map_closures --environment peers

MapClosures asks for another numpy, so it runs in an environment of its own, which is made on first use
(`peers/requirements.txt`). It closes loops between local maps of 100 m of driving, ours between scans. A
closure of maps is right where its pose, between the first scans of the maps, is: maps overlap beyond their scans. A
loop of scans is right where they were taken within `LOOP_M`. Fewer than 10 scans a second (600 in a minute, the
shortest drive) are too few for kiss-icp. The milliseconds of ours hold the compiling.
"""

import dataclasses
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import tyro
from jaxtyping import Bool, Float
from rich.console import Console
from rich.table import Table

import sglpr_jax
from benchmarks.quality.loops import LOOP_M, OTHER_M, REVISIT_M, SUCCESS_DEG, SUCCESS_M, revisits
from sglpr_jax.loops.search import find_loops
from sglpr_jax.se3 import distances, inverse
from sglpr_jax.sim.recording import SimulatedRecording, simulate_recording
from sglpr_jax.sim.sensor import HDL64E

HERE = Path(__file__).resolve().parent


@dataclasses.dataclass(frozen=True)
class Scored:
    """What is counted of one method on one drive."""

    right: Bool[np.ndarray, " k"]
    wrong: Bool[np.ndarray, " k"]
    """Of each loop; what is neither is not counted."""
    found: set[int]
    """The scans that have a right loop."""
    errors: Float[np.ndarray, "k 4 4"]
    """Of each loop: its pose, seen from the true one."""
    seconds: float
    """A scan, without reading it."""


def main(
    *,
    environment: Path = Path("build/peers"),
    towns: Sequence[str] = ("08:101", "00:102", "06:103"),
    scans: int = 1200,
    azimuth_steps: int = 900,
    weights: str = "circular",
    registered: bool = False,
) -> None:
    """Print a table for each town.

    Args:
        environment: the folder of MapClosures' own environment; made where there is none.
        towns: routes and seeds, ROUTE:SEED.
        scans: of each drive.
        azimuth_steps: of the sensor of 64 lasers.
        weights: ours.
        registered: register our loops by their full scans (extra slam).
    """
    python = peer_python(environment)
    params = sglpr_jax.load(weights)
    for town in towns:
        route, seed = town.split(":")
        sensor = dataclasses.replace(HDL64E, azimuth_steps=azimuth_steps)
        drive = simulate_recording(route, scans=scans, sensor=sensor, seed=int(seed))
        peer = run_peer(python, drive)
        odometry = np.array(peer["odometry"])
        rows = {"MapClosures": score_maps(peer, drive)}
        for name, given in (("ours, kiss-icp's odometry", odometry), ("ours, without odometry", None)):
            start = time.perf_counter()
            found = find_loops(drive, params, odometry=given, registered=registered)
            seconds = time.perf_counter() - start
            pairs = [(loop.query, loop.match) for loop in found.loops]
            rows[name] = score(pairs, [loop.match_from_query for loop in found.loops], drive, seconds)
        print_table(f"town {town}, {len(drive)} scans", rows, drive)
        drift = inverse(inverse(drive.poses.world_from_lidar[0]) @ drive.poses.world_from_lidar[-1]) @ (
            inverse(odometry[0]) @ odometry[-1]
        )
        print(f"kiss-icp: {np.linalg.norm(drift[:3, 3]):.2f} m off at the end", end=", ")
        print(f"{1e3 * peer['seconds']['odometry'] / len(drive):.0f} ms a scan, not counted above")


def peer_python(environment: Path) -> Path:
    """The Python of MapClosures' environment, which is made where there is none."""
    python = environment / "bin" / "python"
    if not python.exists():
        subprocess.run([sys.executable, "-m", "venv", environment], check=True)
        subprocess.run(
            [python, "-m", "pip", "install", "--quiet", "-r", HERE / "peers" / "requirements.txt"], check=True
        )
    return python.absolute()


def run_peer(python: Path, drive: SimulatedRecording) -> dict:
    """What MapClosures finds in the scans of a drive."""
    with tempfile.TemporaryDirectory() as folder:
        for i, name in enumerate(drive.ids):
            drive.render(i)[0].astype(np.float32).tofile(Path(folder) / f"{name}.bin")
        out = Path(folder) / "found.json"
        command = [python, HERE / "peers" / "local_maps.py", folder, out]
        ended = subprocess.run(command, capture_output=True, text=True)
        if ended.returncode:
            raise SystemExit(f"MapClosures failed: {ended.stderr[-2000:]}")
        return json.loads(out.read_text())


def score_maps(peer: dict, drive: SimulatedRecording) -> Scored:
    """Closures of local maps: whether their poses are right; scans are found within `LOOP_M` of the other map's."""
    poses, maps = drive.poses.world_from_lidar, [range(*ends) for ends in peer["maps"]]
    right, found, errors = [], set(), []
    for closure in peer["closures"]:
        older, newer = sorted((maps[closure["source"]], maps[closure["target"]]), key=lambda scans: scans.start)
        source, target = (poses[maps[closure[name]].start] for name in ("source", "target"))
        errors.append(inverse(inverse(target) @ source) @ np.array(closure["target_from_source"]))
        right.append(bool(succeeded(errors[-1][None])[0]))
        if right[-1]:
            between = distances(poses[newer, :3, 3], poses[older, :3, 3]).min(axis=1)
            found |= {newer[i] for i in np.flatnonzero(between <= LOOP_M)}
    seconds = peer["seconds"]["maps and closures"] / len(drive)
    said = np.array(right, bool)
    return Scored(said, ~said, found, np.array(errors).reshape(-1, 4, 4), seconds)


def score(
    pairs: Sequence[tuple[int, int]],
    match_from_query: Sequence[Float[np.ndarray, "4 4"]],
    drive: SimulatedRecording,
    seconds: float,
) -> Scored:
    """Loops of scans."""
    poses = drive.poses.world_from_lidar
    apart = np.array([np.linalg.norm(poses[query][:3, 3] - poses[match][:3, 3]) for query, match in pairs])
    found = {query for (query, _), metres in zip(pairs, apart, strict=True) if metres <= LOOP_M}
    errors = [
        inverse(inverse(poses[match]) @ poses[query]) @ pose
        for (query, match), pose in zip(pairs, match_from_query, strict=True)
    ]
    errors = np.array(errors).reshape(-1, 4, 4)
    return Scored(apart <= LOOP_M, apart > OTHER_M, found, errors, seconds / len(drive))


def succeeded(errors: Float[np.ndarray, "k 4 4"]) -> Bool[np.ndarray, " k"]:
    """Which poses are within `SUCCESS_M` and `SUCCESS_DEG` in the plane."""
    metres, degrees = in_plane(errors)
    return (metres < SUCCESS_M) & (degrees < SUCCESS_DEG)


def in_plane(errors: Float[np.ndarray, "k 4 4"]) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """How far and by how many degrees poses are off."""
    turned = np.degrees(np.arctan2(errors[:, 1, 0], errors[:, 0, 0]))
    return np.linalg.norm(errors[:, :2, 3], axis=1), np.abs(turned)


def print_table(title: str, rows: dict[str, Scored], drive: SimulatedRecording) -> None:
    revisited = np.flatnonzero(revisits(drive, drive.poses.world_from_lidar))
    title = f"{title}, {len(revisited)} of them within {REVISIT_M:g} m of one 30 s older"
    columns = ("", "loops", "precision", "recall", f"{SUCCESS_M:g} m, {SUCCESS_DEG:g}°", "m", "°", "ms a scan")
    table = Table(*columns, title=title)
    for name, one in rows.items():
        counted = one.right | one.wrong
        precision = np.mean(one.right[counted]) if counted.any() else np.nan
        recall = np.mean([scan in one.found for scan in revisited]) if len(revisited) else np.nan
        metres, degrees = in_plane(one.errors)
        good = succeeded(one.errors)
        numbers = (precision, recall, good.mean() if len(good) else np.nan)
        medians = (np.median(metres), np.median(degrees)) if len(good) else (np.nan, np.nan)
        cells = [f"{value:.3f}" for value in (*numbers, *medians)]
        table.add_row(name, str(len(one.right)), *cells, f"{1e3 * one.seconds:.0f}")
    Console().print(table)


if __name__ == "__main__":
    tyro.cli(main)
