"""Recordings of a command: those of a dataset, or simulated ones. Messages on stderr describe them."""

import contextlib
import functools
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sglpr_jax.cli.runtime import cache_folder
from sglpr_jax.data import training_recordings
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scan_stream import only_readable
from sglpr_jax.progress import progress_bar

if TYPE_CHECKING:
    from sglpr_jax.sim.dataset import Simulated


def dataset_root(data: Path | None, *, sessions: bool = False, write: bool = True) -> Path:
    """Return the folder `data`, or else one of simulated recordings or sessions of NCLT's layout in the user's cache.

    They are created on first use. Raises FileNotFoundError if they do not exist and `write` is false.
    """
    if data is not None:
        return data
    from sglpr_jax.sim.dataset import default_dataset  # imports the simulator, not needed for real data

    root, options = default_dataset(cache_folder(), sessions=sessions)
    if not write and not root.is_dir():
        raise FileNotFoundError(
            f"{root}: expected the simulated recordings, found none; the command without --plan writes them first, "
            "--data states another dataset"
        )
    if sessions:
        print(f"no --nclt: using the simulated sessions in {root} (for real NCLT: --nclt FOLDER)", file=sys.stderr)
    else:
        kitti = "for real KITTI: --data FOLDER that contains sequences/NN/velodyne"
        print(f"no --data: using the simulated recordings in {root} ({kitti})", file=sys.stderr)
    simulate(root, **options)
    return root


def simulate(root: Path, **options: Any) -> "Simulated":
    """Write a simulated dataset, with the options of `sim.dataset.simulate`, a message and a progress bar."""
    from sglpr_jax.sim import dataset as simulation

    with contextlib.ExitStack() as exit_stack:
        progress_bars = []

        def on_start(dataset: "Simulated") -> None:
            if dataset.missing:
                content = "images" if dataset.layout in ("images", "varied") else "scans"
                size = f"{dataset.scans} {content}, about {dataset.missing_bytes / 1e6:.0f} MB"
                print(f"simulating {len(dataset.missing)} recordings of {size}", file=sys.stderr)
            bar = progress_bar("simulate", dataset.scans * len(dataset.names))
            progress_bars.append(exit_stack.enter_context(bar))

        return simulation.simulate(root, **options, on_start=on_start, on_progress=lambda done: progress_bars[0](done))


def leave_one_out(
    roots: Sequence[Path], seq: str, *, train_seqs: Sequence[str] = (), **options: Any
) -> tuple[list[Recording], Recording]:
    """Return the training recordings of datasets and the held-out recording `seq`, and describe them on stderr."""
    recordings, test = training_recordings.leave_one_out(roots, seq, train=train_seqs, **options)
    names = ", ".join(recording.name for recording in recordings)
    print(f"training on {names}; testing on {seq}, which is held out", file=sys.stderr)
    _print_descriptions([*recordings, test])
    return recordings, test


def all_recordings(root: Path, *, title: str = "also training on", **options: Any) -> list[Recording]:
    """Return all recordings of a dataset, and describe them on stderr after `title`."""
    recordings = training_recordings.all_recordings(root, **options)
    print(f"{title} {', '.join(recording.name for recording in recordings)} of {root}", file=sys.stderr)
    _print_descriptions(recordings)
    return recordings


def without_bad_scans(
    recordings: Sequence[Recording], *, on_bad_scan: Callable[[str, Exception], None]
) -> list[Recording]:
    """Read all scans and return the recordings without unreadable scans. `on_bad_scan` receives each of these."""
    with progress_bar("read all scans", sum(map(len, recordings))) as show:
        readable_recordings, scans_before = [], 0
        for recording in recordings:
            show_total = functools.partial(lambda before, scans: show(before + scans), scans_before)
            readable_recordings.append(only_readable(recording, on_bad_scan=on_bad_scan, on_progress=show_total))
            scans_before += len(recording)
    return readable_recordings


def _print_descriptions(recordings: Sequence[Recording]) -> None:
    for recording in recordings:
        print("; ".join(recording.description), file=sys.stderr)
