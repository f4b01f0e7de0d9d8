"""From a scan's file to its descriptor: scans a second of `embed`, and the share of reading, image and network."""

import functools
import itertools
import os
import tempfile
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np

import sglpr_jax
from benchmarks.timing import clocked, in_turn, warn_if_busy
from sglpr_jax.data.views import view
from sglpr_jax.models.weights import Params

BATCH = 8


def embed(
    *,
    data: Path | None = None,
    weights: tuple[str, ...] = ("sglpr", "sglpr-small"),
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
        recording = sglpr_jax.open_recording(_many_files(data, Path(folder), scans, azimuth_steps))
        for name in weights:
            params = sglpr_jax.load(name)
            jobs = _parts(params, recording)
            jobs["all"] = functools.partial(sglpr_jax.embed, params, recording, batch=BATCH)
            *parts, whole = in_turn([clocked(job) for job in jobs.values()], repeats=repeats).min(axis=0).tolist()
            said = ", ".join(f"{part} {1e3 * seconds / BATCH:.2f}" for part, seconds in zip(jobs, parts, strict=False))
            print(
                f"{name}: {len(recording) / whole:.0f} scans/s; {1e3 * whole / len(recording):.2f} ms a scan in all; "
                f"each part alone, in batches of {BATCH}, ms: {said}"
            )


def _many_files(data: Path | None, folder: Path, scans: int, azimuth_steps: int) -> Path:
    """A folder of so many scans: links to those of `data`, or to a few simulated ones, in turn."""
    if data is None:
        data = folder / "simulated"
        sglpr_jax.simulate(data, routes=("08",), scans=20, azimuth_steps=azimuth_steps)
    files = sorted(path for path in data.rglob("*.bin") if not path.name.startswith("."))
    if not files:
        raise SystemExit(f"{data}: expected .bin files, found none")
    many = folder / "scans"
    many.mkdir()
    for number, file in zip(range(scans), itertools.cycle(files), strict=False):
        (many / f"{number:06d}.bin").symlink_to(file.resolve())
    return many


def _parts(params: Params, recording: sglpr_jax.Recording) -> dict[str, Callable[[], object]]:
    """What each part does for one batch."""
    records = [recording.scan(row) for row in range(BATCH)]

    def see(scan: sglpr_jax.Scan) -> np.ndarray:
        return np.asarray(view(scan, params.config.grid, image=params.config.image).image)

    images = np.stack([see(scan) for scan in records])
    return {
        "reading": lambda: [recording.scan(row) for row in range(BATCH)],
        "image": lambda: [see(scan) for scan in records],
        "network": lambda: jax.block_until_ready(sglpr_jax.describe(params, images)),
    }
