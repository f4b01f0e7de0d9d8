"""Time until commands start, and until the first scan is described."""

import dataclasses
import os
import shutil
import sys
import tempfile
from pathlib import Path

import numpy as np

from benchmarks.drives import on_disk
from benchmarks.table import Table
from benchmarks.timing import run_command
from sglpr_jax.sim.recording import simulate_recording
from sglpr_jax.sim.sensor import SENSORS

BIN = Path(__file__).resolve().parents[2] / "bin"
COMMANDS = tuple(
    sorted(path.stem for path in (BIN.parent / "sglpr_jax" / "cli").glob("*.py") if (BIN / path.stem).exists())
)


DESCRIBE = """
import numpy as np, sglpr_jax
params = sglpr_jax.load("{weights}")
sglpr_jax.describe(params, np.zeros((128, 128), np.float32)).block_until_ready()
"""


def start_up(
    *, commands: tuple[str, ...] = COMMANDS, weights: str = "sglpr", places: int = 1000, repeats: int = 9
) -> None:
    """Time commands in processes of their own, one after another: under `taskset -c 1`.

    The descriptor of one scan is timed cold (nothing compiled yet, once) and warm, as is the pose of a scan in a map.
    Processor seconds are nearer the truth on a machine that is busy.

    Args:
        commands: whose help is timed.
        weights: shipped weights that describe the scan.
        places: places of the map.
        repeats: how often each is timed.
    """
    table = Table("", "seconds, least", "median", "processor seconds, least", "median")
    with tempfile.TemporaryDirectory() as folder:
        sensor = dataclasses.replace(SENSORS["vlp16"], azimuth_steps=900)
        drive = simulate_recording("08", scans=places, sensor=sensor)
        on_disk(drive, Path(folder) / "drive")
        np.savetxt(Path(folder) / "poses.txt", drive.poses.world_from_lidar[:, :3].reshape(places, 12))
        (Path(folder) / "scans").mkdir()
        shutil.copy(Path(folder) / "drive" / "000000.bin", Path(folder) / "scans")
        environment = {**os.environ, "XDG_CACHE_HOME": folder, "PYTHONPATH": str(BIN.parent)}
        # The commands keep compiled programs in the cache folder. Programs of users do if they ask for it.
        environment["JAX_COMPILATION_CACHE_DIR"] = f"{folder}/compiled"
        environment["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"

        def ours(line: str) -> tuple[str, ...]:
            return sys.executable, "-m", "sglpr_jax.cli", *line.split()

        embed = ours(f"embed --weights {weights} --data scans --out scans.npz")
        relocalize = ours(f"relocalize scans/000000.bin --map map.safetensors --weights {weights}")
        describe = (sys.executable, "-c", DESCRIBE.format(weights=weights))
        build = ours(
            f"map drive --poses poses.txt --pose-format lidar --spacing-m 0 --out map.safetensors --weights {weights}"
        )
        run_command(build, {**environment, "JAX_COMPILATION_CACHE_DIR": f"{folder}/other"}, folder)
        lines = [("embed one scan, cold", embed, 1), ("embed one scan, warm", embed, repeats)]
        lines += [("load and describe, warm", describe, repeats)]
        name = f"relocalize in {places} places"
        lines += [(f"{name}, cold", relocalize, 1), (f"{name}, warm", relocalize, repeats)]
        lines += [(f"{command} --help", ours(f"{command} --help"), repeats) for command in commands]
        for title, command, times in lines:
            seconds = np.array([run_command(command, environment, folder) for _ in range(times)])
            table.add(title, *(f"{value:.2f}" for values in seconds.T for value in (values.min(), np.median(values))))
    print(f"{repeats} times each; {os.cpu_count()} CPUs, load average {os.getloadavg()[0]:.1f}")
