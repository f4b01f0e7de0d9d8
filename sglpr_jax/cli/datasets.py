"""Which recordings a command works on, said on stderr: those of a named dataset, or the simulated ones."""

import contextlib
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sglpr_jax.cli.runtime import cache_folder, progress_bar
from sglpr_jax.data import Recording, readers
from sglpr_jax.data import leave_one_out as split
from sglpr_jax.data.readable import readable

if TYPE_CHECKING:
    from sglpr_jax.sim import Simulated


def dataset_root(data: Path | None) -> Path:
    """The dataset's folder; without one, the simulated recordings, made on first use and kept in the user's cache."""
    if data is not None:
        return data
    from sglpr_jax.sim.simulation import default_dataset  # this brings the simulator, which real data does not need

    root, options = default_dataset(cache_folder())
    print(
        f"no dataset named: using the simulated recordings in {root} "
        "(for real KITTI: --data FOLDER, which holds sequences/NN/velodyne)",
        file=sys.stderr,
    )
    simulate(root, **options)
    return root


def cached_sessions() -> Path:
    """The folder of the simulated sessions in NCLT's layout, made on first use and kept in the user's cache."""
    from sglpr_jax.sim.simulation import default_sessions

    root, options = default_sessions(cache_folder())
    print(f"no sessions named: using the simulated ones in {root} (for real NCLT: --nclt FOLDER)", file=sys.stderr)
    simulate(root, **options)
    return root


def simulate(root: Path, **options: Any) -> "Simulated":
    """Do what `sim.simulate` does, with the size said beforehand and the progress shown."""
    from sglpr_jax import sim

    with contextlib.ExitStack() as opened:
        bars = []

        def start(dataset: "Simulated") -> None:
            _announce(dataset)
            bars.append(opened.enter_context(progress_bar("simulate", dataset.scans * len(dataset.names))))

        return sim.simulate(root, **options, on_start=start, on_progress=lambda done: bars[0](done))


def _announce(dataset: "Simulated") -> None:
    if dataset.missing:
        what = "images" if dataset.layout == "images" else "scans"
        print(
            f"simulating {len(dataset.missing)} recordings of {dataset.scans} {what}, "
            f"about {dataset.missing_bytes / 1e6:.0f} MB",
            file=sys.stderr,
        )


def open_recording(root: Path, name: str | None, **options: Any) -> Recording:
    """Do what `data.open_recording` does, and say what was found."""
    recording = readers.open_recording(root, name, **options)
    print("\n".join(recording.description), file=sys.stderr)
    return recording


def leave_one_out(
    root: Path, seq: str, *, train_seqs: Sequence[str] = (), **options: Any
) -> tuple[list[Recording], Recording]:
    """Return what `data.leave_one_out` does, and say which they are and what was found of each."""
    recordings, test = split.leave_one_out(root, seq, train=train_seqs, **options)
    names = ", ".join(recording.name for recording in recordings)
    print(f"training on {names}; testing on {seq}, never seen", file=sys.stderr)
    _describe([*recordings, test])
    return recordings, test


def all_recordings(root: Path, **options: Any) -> list[Recording]:
    """Return every recording of a dataset that is trained on beside another; say which and what was found of each."""
    recordings = split.all_recordings(root, **options)
    print(f"training on {', '.join(recording.name for recording in recordings)} of {root} too", file=sys.stderr)
    _describe(recordings)
    return recordings


def without_bad_scans(
    recordings: Sequence[Recording], *, on_bad_scan: Callable[[str, Exception], None]
) -> list[Recording]:
    """Return the recordings without the scans that cannot be read, each of which `on_bad_scan` is told of."""
    with progress_bar("read all scans", sum(map(len, recordings))) as show:
        found, done = [], 0
        for recording in recordings:
            before = done
            found.append(readable(recording, on_bad_scan=on_bad_scan, on_progress=lambda i, n=before: show(n + i)))
            done += len(recording)
    return found


def _describe(recordings: Sequence[Recording]) -> None:
    for recording in recordings:
        print("; ".join(recording.description), file=sys.stderr)
