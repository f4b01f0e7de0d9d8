"""Reading the batches of a training from a packed recording, against reading them from its files."""

import os
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import jax
import numpy as np
import tyro

from benchmarks.speed.ratio import report
from sglpr_jax.data.packed import packed
from sglpr_jax.data.readers import open_recording, recording_names
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.sampling.batch import Batch
from sglpr_jax.training.batches import TupleBatches, tuple_pool
from sglpr_jax.training.presets import load_preset

Open = Callable[[], Sequence[Recording]]


def main(
    data: Path,
    cache: Path,
    *,
    seqs: tuple[str, ...] = (),
    preset: str = "sglpr",
    count: int = 4,
    repeats: int = 10,
    cold: bool = False,
) -> None:
    """Time both in one thread, as training reads ahead; first their batches must be equal to the bit.

    Args:
        data: the dataset.
        cache: the folder of the packs, which are made first where they are missing.
        seqs: the recordings; none: all.
        preset: says how many places a batch has, and how large clouds may be.
        count: batches read in one timing, others at every repeat.
        repeats: how often both are timed against each other.
        cold: have the system forget all these files before each timing, so that the disk is read.
    """
    config = load_preset(preset)
    files = [open_recording(data, name) for name in seqs or recording_names(data)]
    pool = tuple_pool(files, config)
    make_packs(files, cache)
    sources: tuple[Open, ...] = (lambda: [packed(each, cache) for each in files], lambda: files)

    def read(source: Open, steps: Iterable[int]) -> tuple[list[Batch], float]:
        if cold:
            forget([*paths_of(files), *cache.rglob("*.bin")])
        make_batch = TupleBatches(source(), pool, config).batch
        start = time.perf_counter()
        made = [make_batch(step) for step in steps]
        return made, time.perf_counter() - start

    check_same(*(read(source, range(1))[0] for source in sources))
    seconds = np.zeros((repeats, 2))
    for repeat in range(repeats):
        for i in (0, 1) if repeat % 2 else (1, 0):
            seconds[repeat, i] = read(sources[i], range(repeat * count, (repeat + 1) * count))[1]
    title = f"one batch of {config.images} places, {'from the disk' if cold else 'from the page cache where it can be'}"
    rows = [(preset, *(seconds / count).T)]
    report(title, rows, other="files", ours="pack", packages=("numpy",), threads=1)


def make_packs(recordings: Sequence[Recording], cache: Path) -> None:
    """Pack what is not packed yet, and print how long it took and how large all is."""
    start = time.perf_counter()
    for recording in recordings:
        packed(recording, cache)
    seconds = time.perf_counter() - start
    scans, read = sum(map(len, recordings)), sum(path.stat().st_size for path in paths_of(recordings))
    written = sum(path.stat().st_size for path in cache.rglob("*.bin"))
    print(f"{scans} scans of {read / 1e6:.0f} MB packed or found packed in {seconds:.1f} s; {written / 1e6:.0f} MB")


def check_same(ours: list[Batch], theirs: list[Batch]) -> None:
    """Raises SystemExit where a batch differs in any bit."""
    pairs = zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True)
    if not all(np.asarray(a).tobytes() == np.asarray(b).tobytes() for a, b in pairs):
        raise SystemExit("the batches of packs and files differ, so there is nothing to time")


def paths_of(recordings: Sequence[Recording]) -> list[Path]:
    """The files of some recordings."""
    return [path for each in recordings for path in (*each.paths, *each.label_paths) if path is not None]


def forget(paths: Iterable[Path]) -> None:
    """Have the system drop from memory what it holds of these files; what a process has mapped stays."""
    for path in paths:
        handle = os.open(path, os.O_RDONLY)
        try:
            os.posix_fadvise(handle, 0, 0, os.POSIX_FADV_DONTNEED)
        finally:
            os.close(handle)


if __name__ == "__main__":
    tyro.cli(main)
