"""From a scan's file to its descriptor: scans a second of `embed`, and the share of reading, image and network.

python -m benchmarks.speed.embed                        on simulated scans of 64 x 1800 rays
python -m benchmarks.speed.embed --data my_scans        on a folder of scans
"""

import functools
import itertools
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np
import tyro

import sglpr_jax
from benchmarks.speed.ratio import warn_if_busy
from sglpr_jax.data.views import view
from sglpr_jax.models.params import Params

SIMULATED = {"routes": ("08",), "scans": 20, "azimuth_steps": 1800}
BATCH = 8


def main(
    *,
    data: Path | None = None,
    weights: tuple[str, ...] = ("sglpr", "circular"),
    scans: int = 640,
    repeats: int = 3,
    azimuth_steps: int = 1800,
) -> None:
    """Time the way from files to descriptors.

    Args:
        data: a dataset or a folder of scans, which are read again and again under other names. None: simulated ones.
        weights: names of shipped weights, or folders.
        scans: how many files.
        repeats: runs, of which the fastest counts.
        azimuth_steps: rays per turn of the simulated scans.
    """
    warn_if_busy(os.cpu_count() or 1)
    with tempfile.TemporaryDirectory() as folder:
        recording = sglpr_jax.open_recording(many_files(data, Path(folder), scans, azimuth_steps))
        for name in weights:
            params = sglpr_jax.load(name)
            parts = {part: best(job, repeats) / BATCH for part, job in parts_of(params, recording).items()}
            run = functools.partial(sglpr_jax.embed, params, recording, batch=BATCH)
            whole = best(run, repeats) / len(recording)
            said = ", ".join(f"{part} {1e3 * seconds:.2f}" for part, seconds in parts.items())
            print(
                f"{name}: {1 / whole:.0f} scans/s; {1e3 * whole:.2f} ms a scan in all; "
                f"each part alone, in batches of {BATCH}, ms: {said}"
            )


def many_files(data: Path | None, folder: Path, scans: int, azimuth_steps: int) -> Path:
    """A folder of so many scans: links to those of `data`, or to a few simulated ones, in turn."""
    if data is None:
        data = folder / "simulated"
        sglpr_jax.simulate(data, **SIMULATED | {"azimuth_steps": azimuth_steps})
    files = sorted(path for path in data.rglob("*.bin") if not path.name.startswith("."))
    if not files:
        raise SystemExit(f"{data}: expected .bin files, found none")
    many = folder / "scans"
    many.mkdir()
    for number, file in zip(range(scans), itertools.cycle(files), strict=False):
        (many / f"{number:06d}.bin").symlink_to(file.resolve())
    return many


def parts_of(params: Params, recording: sglpr_jax.Recording) -> dict[str, Callable[[], object]]:
    """What each part does for one batch."""
    records = [recording.record(row) for row in range(BATCH)]

    def see(record: sglpr_jax.Record) -> np.ndarray:
        return np.asarray(view(record, params.config.grid, image=params.config.image).image)

    images = np.stack([see(record) for record in records])
    return {
        "reading": lambda: [recording.record(row) for row in range(BATCH)],
        "image": lambda: [see(record) for record in records],
        "network": lambda: jax.block_until_ready(sglpr_jax.describe(params, images)),
    }


def best(job: Callable[[], object], repeats: int) -> float:
    """The seconds of the fastest run, after one that compiles."""
    job()
    seconds = []
    for _ in range(repeats):
        begun = time.perf_counter()
        job()
        seconds.append(time.perf_counter() - begun)
    return min(seconds)


if __name__ == "__main__":
    tyro.cli(main)
