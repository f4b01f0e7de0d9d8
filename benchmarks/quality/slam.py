"""From raw scans to a trajectory: kiss-slam, MapClosures and ours with odometry included, each a process of its own.

    python -m benchmarks.quality.slam --environment build/peers --drives hdl64e:08:101 os1-64:00:102

Each process reads the same files of simulated scans, 10 a second. kiss-slam and MapClosures run in an
environment of their own, which is made on first use (`peers/requirements.txt`); ours is `bin/loops --odometry auto
--optimize`. MapClosures does not correct its odometry, which is that of kiss-icp. Seconds and processor seconds are
those of the whole process, with imports, compiling and the pages that ours writes.

kiss-slam and MapClosures close loops between local maps of 100 m. Such a loop is right if two of their scans were taken
within `LOOP_M`, and wrong if all are farther apart than `OTHER_M`. The same holds for the two scans of our loops.
Recall: revisits of a place within `REVISIT_M` after 30 s that are in a right loop. Errors of trajectories are those of
`evo_ape tum -a`: the root mean square of positions after rigid alignment.
"""

import dataclasses
import json
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tyro
from jaxtyping import Float

from benchmarks.quality.loops import LOOP_M, OTHER_M, revisits
from benchmarks.quality.map_closures import peer_python
from sglpr_jax.data.formats.pose_files import read_tum
from sglpr_jax.files import replacing
from sglpr_jax.pose_graph.files import read_loops_jsonl, write_tum
from sglpr_jax.se3 import distances
from sglpr_jax.sim.recording import simulate_recording
from sglpr_jax.sim.sensor import SENSORS

PEERS = Path(__file__).resolve().parent / "peers"
RATE_HZ = 10.0


class Rendered(NamedTuple):
    """Files of a drive."""

    folder: Path
    height_m: float
    times: Float[np.ndarray, " n"]
    world_from_lidar: Float[np.ndarray, "n 4 4"]
    revisited: np.ndarray
    """Scans that revisit a place."""


class Found(NamedTuple):
    """What a method found, and what it took."""

    pairs: list[tuple[np.ndarray, np.ndarray]]
    """Scans of the newer and of the older side of each loop."""
    trajectory: Float[np.ndarray, "n 4 4"]
    seconds: float = 0.0
    processor_seconds: float = 0.0


def main(
    *,
    environment: Path = Path("build/peers"),
    drives: Sequence[str] = ("hdl64e:08:101", "hdl64e:00:102", "os1-64:08:103", "os1-64:00:104"),
    scans: int = 1000,
    azimuth_steps: int = 900,
    out: Path = Path("build/slam"),
) -> None:
    """Print a table.

    Args:
        environment: the folder of the peers' own environment; made where there is none.
        drives: sensors, routes and seeds, SENSOR:ROUTE:SEED. Route 00 revisits places in the same direction, 08 in the
            opposite direction.
        scans: of each drive, 10 a second.
        azimuth_steps: firings of the sensor per turn.
        out: folder of scans and results.
    """
    python = peer_python(environment)
    columns = ("drive", "method", "s", "processor s", "loops", "right", "wrong", "recall", "error m")
    print(f"| {' | '.join(columns)} |\n|{'---|' * len(columns)}")
    for name in drives:
        drive = rendered(out, name, scans=scans, azimuth_steps=azimuth_steps)
        for method, run in (("kiss-slam", kiss_slam), ("MapClosures", map_closures), ("ours", ours)):
            found = run(drive, python)
            error = evo_error(found.trajectory, drive, python)
            print(f"| {name} | {method} | {row(found, drive)} | {error:.2f} |", flush=True)


def rendered(out: Path, name: str, *, scans: int, azimuth_steps: int) -> Rendered:
    """The scans of a drive, rendered unless they exist."""
    folder = out / f"{name.replace(':', '-')}-{scans}x{azimuth_steps}"
    kind, route, seed = name.split(":")
    sensor = dataclasses.replace(SENSORS[kind], azimuth_steps=azimuth_steps)
    drive = simulate_recording(route, scans=scans, sensor=sensor, seed=int(seed), rate_hz=RATE_HZ)
    if not folder.exists():
        with replacing(folder) as temporary:
            temporary.mkdir()
            for i, scan in enumerate(drive.ids):
                drive.render(i)[0].astype("<f4").tofile(temporary / f"{scan}.bin")
            np.savetxt(temporary / "times.txt", drive.poses.times)
    poses = drive.poses.world_from_lidar
    return Rendered(folder, sensor.height_m, drive.poses.times, poses, np.flatnonzero(revisits(drive, poses)))


def kiss_slam(drive: Rendered, python: Path) -> Found:
    """Run kiss-slam."""
    return _of_maps(drive, python, "kiss_slam_of_scans.py", "trajectory")


def map_closures(drive: Rendered, python: Path) -> Found:
    """Run kiss-icp and MapClosures."""
    return _of_maps(drive, python, "local_maps.py", "odometry")


def ours(drive: Rendered, _python: Path) -> Found:
    """Run `bin/loops`."""
    out = drive.folder.with_name(f"{drive.folder.name}-ours")
    flags = [
        "--format",
        "kitti",
        "--sensor-height",
        str(drive.height_m),
        "--odometry",
        "auto",
        "--optimize",
        "--out",
        out,
    ]
    taken = timed([sys.executable, "-m", "sglpr_jax.cli.loops", drive.folder, *flags])
    pairs = [(np.array([one.query]), np.array([one.match])) for one in read_loops_jsonl(out / "loops.jsonl")]
    return Found(pairs, read_tum(out / "trajectory-optimized.tum")[0], *taken)


def _of_maps(drive: Rendered, python: Path, program: str, trajectory: str) -> Found:
    """Run a program that closes loops between local maps."""
    out = drive.folder.with_name(f"{drive.folder.name}-{program}.json")
    taken = timed([python, PEERS / program, drive.folder, out])
    said = json.loads(out.read_text())
    maps = [np.arange(*ends) for ends in said["maps"]]
    closed = [sorted((one["source"], one["target"]), reverse=True) for one in said["closures"]]
    return Found([(maps[newer], maps[older]) for newer, older in closed], np.array(said[trajectory]), *taken)


def timed(command: Sequence[str | Path]) -> tuple[float, float]:
    """Run a command. Return its seconds and processor seconds."""
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    ended = subprocess.run(command, capture_output=True, text=True, env=dict(os.environ))
    if ended.returncode:
        raise SystemExit(f"{command[:3]} failed: {ended.stderr[-2000:]}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    processor = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return time.perf_counter() - start, processor


def row(found: Found, drive: Rendered) -> str:
    """Cells of the table."""
    positions, right, wrong, in_loop = drive.world_from_lidar[:, :3, 3], 0, 0, set[int]()
    for newer, older in found.pairs:
        apart = distances(positions[newer], positions[older]).min(axis=1)
        right, wrong = right + int(apart.min() <= LOOP_M), wrong + int(apart.min() > OTHER_M)
        in_loop |= set(newer[apart <= LOOP_M].tolist())
    recall = np.mean([scan in in_loop for scan in drive.revisited.tolist()]) if len(drive.revisited) else np.nan
    cells = (f"{found.seconds:.0f}", f"{found.processor_seconds:.0f}", len(found.pairs), right, wrong)
    return " | ".join(map(str, (*cells, f"{recall:.2f} of {len(drive.revisited)}")))


def evo_error(trajectory: Float[np.ndarray, "n 4 4"], drive: Rendered, python: Path) -> float:
    """Error of a trajectory in metres, by evo."""
    with tempfile.TemporaryDirectory() as folder:
        truth, estimate = Path(folder) / "truth.tum", Path(folder) / "estimate.tum"
        write_tum(truth, drive.world_from_lidar, drive.times)
        write_tum(estimate, trajectory, drive.times)
        command = [python.with_name("evo_ape"), "tum", truth, estimate, "-a"]
        ended = subprocess.run(command, capture_output=True, text=True, check=True)
    return float(dict(re.findall(r"(\w+)\s+([\d.]+)", ended.stdout))["rmse"])


if __name__ == "__main__":
    tyro.cli(main)
