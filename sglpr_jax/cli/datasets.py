"""Recordings of a command: those of a dataset, or simulated ones. They are described on stderr."""

import contextlib
import functools
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sglpr_jax.cli.runtime import cache_folder
from sglpr_jax.data import training_recordings as split
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scan_stream import only_readable
from sglpr_jax.progress import progress_bar

if TYPE_CHECKING:
    from sglpr_jax.sim.dataset import Simulated


def dataset_root(data: Path | None, *, sessions: bool = False, write: bool = True) -> Path:
    """Return the dataset's folder. Without one, the simulated recordings, or sessions in NCLT's layout, are created in
    the user's cache on first use. Raises FileNotFoundError if they do not exist and `write` is false."""
    if data is not None:
        return data
    from sglpr_jax.sim.dataset import default_dataset  # imports the simulator, not needed for real data

    root, options = default_dataset(cache_folder(), sessions=sessions)
    if not write and not root.is_dir():
        raise FileNotFoundError(
            f"{root}: expected the simulated recordings, found none; the command without --plan writes them first, "
            "--data states another dataset"
        )
    flag, what = ("--nclt", "sessions") if sessions else ("--data", "recordings")
    real = "NCLT: --nclt FOLDER" if sessions else "KITTI: --data FOLDER that contains sequences/NN/velodyne"
    print(f"no {flag}: using the simulated {what} in {root} (for real {real})", file=sys.stderr)
    simulate(root, **options)
    return root


def simulate(root: Path, **options: Any) -> "Simulated":
    """Run `sim.dataset.simulate`, with a message about the size and a progress bar."""
    from sglpr_jax.sim import dataset as simulation

    with contextlib.ExitStack() as opened:
        bars = []

        def start(dataset: "Simulated") -> None:
            if dataset.missing:
                what = "images" if dataset.layout == "images" else "scans"
                size = f"{dataset.scans} {what}, about {dataset.missing_bytes / 1e6:.0f} MB"
                print(f"simulating {len(dataset.missing)} recordings of {size}", file=sys.stderr)
            bars.append(opened.enter_context(progress_bar("simulate", dataset.scans * len(dataset.names))))

        return simulation.simulate(root, **options, on_start=start, on_progress=lambda done: bars[0](done))


def leave_one_out(
    root: Path, seq: str, *, train_seqs: Sequence[str] = (), **options: Any
) -> tuple[list[Recording], Recording]:
    """Run `data.training_recordings` and describe the recordings on stderr."""
    recordings, test = split.leave_one_out(root, seq, train=train_seqs, **options)
    names = ", ".join(recording.name for recording in recordings)
    print(f"training on {names}; testing on {seq}, which is held out", file=sys.stderr)
    _describe([*recordings, test])
    return recordings, test


def all_recordings(root: Path, *, title: str = "also training on", **options: Any) -> list[Recording]:
    """Return all recordings of a dataset, and describe them on stderr after `title`."""
    recordings = split.all_recordings(root, **options)
    print(f"{title} {', '.join(recording.name for recording in recordings)} of {root}", file=sys.stderr)
    _describe(recordings)
    return recordings


def without_bad_scans(
    recordings: Sequence[Recording], *, on_bad_scan: Callable[[str, Exception], None]
) -> list[Recording]:
    """Read all scans and return the recordings without the unreadable ones. `on_bad_scan` is called for each of
    these."""
    with progress_bar("read all scans", sum(map(len, recordings))) as show:
        good, done = [], 0
        for recording in recordings:
            show_from = functools.partial(lambda start, scans: show(start + scans), done)
            good.append(only_readable(recording, on_bad_scan=on_bad_scan, on_progress=show_from))
            done += len(recording)
    return good


def _describe(recordings: Sequence[Recording]) -> None:
    for recording in recordings:
        print("; ".join(recording.description), file=sys.stderr)
