"""Kill bin/map at random times, again and again: the map opens every time, or is not there yet.

    python -m benchmarks.robustness.kill_map
    python -m benchmarks.robustness.kill_map --kills 3 --scans 40

Every second kill comes while the map is being written, the others at any time of a run. The map is one that grows
(`--add-to` itself, with other poses each time), so that a file is replaced, too.
"""

import contextlib
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np
import tyro
from rich.progress import track

import sglpr_jax
from sglpr_jax.files import half_written, remove_half_written
from sglpr_jax.maps.place_map import PlaceMap
from sglpr_jax.pose_graph.files import write_tum
from sglpr_jax.sim.dataset import simulate
from sglpr_jax.sim.sensor import Sensor

SENSOR = Sensor(elevations_deg=(2.0, -2.0, -6.0, -10.0, -14.0, -18.0, -21.0, -24.0), azimuth_steps=60)
FINISHED_S = 0.05
"""After a run has begun to write, the kill comes within so many seconds."""


def main(kills: int = 100, scans: int = 200, seed: int = 0) -> None:
    """Kill runs of bin/map and open the map after each.

    Args:
        kills: how many.
        scans: of the simulated recording.
        seed: of the moments.
    """
    rng = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        command, out = prepared(folder, scans)
        seconds = duration(command)
        out.unlink()
        outcomes: Counter[str] = Counter()
        for kill in track(range(kills), description="kills"):
            grown = [*command, "--add-to", str(out)] if out.exists() else command
            places = len(PlaceMap.load(out)) if out.exists() else 0
            write_poses(folder, x=float(kill))
            begin = time.monotonic()
            process = subprocess.Popen(grown, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            if kill % 2:
                wait_for_write(process, out)
                time.sleep(rng.uniform(0, FINISHED_S))
            else:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(rng.uniform(0, seconds) - (time.monotonic() - begin))
            outcomes["ended before the kill" if process.poll() is not None else "killed"] += 1
            process.kill()
            process.wait()
            outcomes["left half of a file beside it"] += bool(half_written(out.parent))
            remove_half_written(folder)
            outcomes[state(out, places, scans)] += 1
            if places > 20 * scans:
                out.unlink()
    print(f"{kills} kills, a run takes {seconds:.1f} s: " + ", ".join(f"{n} {what}" for what, n in outcomes.items()))
    sys.exit(1 if outcomes["damaged"] else 0)


def prepared(folder: Path, scans: int) -> tuple[list[str], Path]:
    """A simulated recording with poses; the command that maps it, and the map."""
    simulate(folder / "town", routes=("08",), scans=scans, sensor=SENSOR)
    write_poses(folder)
    out = folder / "map" / "town.safetensors"
    command = [sys.executable, "-m", "sglpr_jax.cli.map", folder / "town", "--seq", "08", "--out", out]
    return [*map(str, command), "--poses", str(folder / "poses.tum"), "--spacing-m", "0"], out


def write_poses(folder: Path, *, x: float = 0.0) -> None:
    """The poses of the recording, all of them `x` metres aside: scans of other poses are other places."""
    recording = sglpr_jax.open_recording(folder / "town", "08")
    poses = np.tile(np.eye(4), (len(recording), 1, 1))
    poses[:, :3, 3] = recording.positions
    poses[:, 0, 3] += x
    write_tum(folder / "poses.tum", poses, np.arange(float(len(recording))))


def duration(command: list[str]) -> float:
    """Seconds of a run that nobody kills; the first one compiles."""
    for _ in range(2):
        begin = time.monotonic()
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    return time.monotonic() - begin


def wait_for_write(process: subprocess.Popen, out: Path) -> None:
    """Until the map's hidden file is there, or the process has ended."""
    while process.poll() is None and not half_written(out.parent):
        time.sleep(0.001)


def state(out: Path, before: int, scans: int) -> str:
    """What has become of the map."""
    if not out.exists():
        return "absent" if not before else "damaged"
    try:
        places = len(PlaceMap.load(out))
    except ValueError:
        return "damaged"
    return {before: "opened as before", before + scans: "opened with the new places"}.get(places, "damaged")


if __name__ == "__main__":
    tyro.cli(main)
