"""Inputs of the network for all scans of recordings. They are computed once and kept as memory-mapped files."""

import hashlib
import inspect
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Int, Shaped

from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scan_stream import check_readable, require_content, scan_stream
from sglpr_jax.files import file_name, in_short, replacing
from sglpr_jax.methods.learned.method import LearnedMethod
from sglpr_jax.methods.method import LABELLED
from sglpr_jax.progress import Progress, no_progress
from sglpr_jax.training.batches import positions_of
from sglpr_jax.training.tuples import TuplePool

SCANS_AHEAD = 8
"""Number of scans that are read ahead."""


@dataclass(frozen=True, eq=False)
class TrainingInputs:
    """Recordings and the inputs of their scans."""

    recordings: tuple[Recording, ...]
    inputs: tuple[Shaped[np.ndarray, "_n ..."], ...]
    """Inputs of each recording, one for each scan."""

    def of(self, pool: TuplePool, places: Int[np.ndarray, " n"]) -> Shaped[np.ndarray, "n ..."]:
        """Return the inputs of places, given as frame numbers of a pool over these recordings."""
        return np.stack([self.inputs[pool.recording_of[place]][pool.frame_of[place]] for place in places])


def prepare_inputs(
    method: LearnedMethod, recordings: Sequence[Recording], cache: Path, *, progress: Progress = no_progress
) -> TrainingInputs:
    """Compute the inputs of all scans, or read them from the cache.

    Each recording becomes one file in the folder `cache`, which is complete or does not exist. A repeated call
    continues with the missing recordings.

    Raises:
      ValueError: If a recording has no poses or lacks what the method needs, if a scan is invalid, or if inputs differ
        in shape or type.
      OSError: If the cache cannot be written.
    """
    for recording in recordings:
        require_content(method.name, method.takes, recording, every_label=True)
        positions_of(recording)
    inputs = tuple(_inputs(method, recording, cache, progress) for recording in recordings)
    for recording, array in zip(recordings, inputs, strict=True):
        _require_alike(array[0], inputs[0][0], name=f"sequence {recording.name}")
    return TrainingInputs(tuple(recordings), inputs)


def _inputs(method: LearnedMethod, recording: Recording, cache: Path, progress: Progress) -> np.ndarray:
    path = cache / f"{method.name}-{file_name(recording.name)}-{_identity(method, recording)}.npy"
    if not path.is_file():
        with progress(f"prepare {recording.name}", len(recording)) as show:
            _write(path, method, recording, show)
    try:
        inputs = np.load(path, mmap_mode="r", allow_pickle=False)
    except (ValueError, EOFError) as error:
        raise ValueError(f"{path}: expected inputs, found a damaged file ({in_short(error)}); delete it") from error
    if len(inputs) != len(recording):
        raise ValueError(f"{path}: expected {len(recording)} inputs, found {len(inputs)}; delete the file")
    return inputs


def _write(path: Path, method: LearnedMethod, recording: Recording, show) -> None:
    """Write the inputs of a recording, completely or not at all."""
    check_readable(recording, len(recording))
    options = {"labels": method.takes in LABELLED, "ahead": SCANS_AHEAD, "on_progress": show}
    stream = scan_stream(recording, lambda row, scan: method.prepare(scan), **options)
    with replacing(path) as temporary:
        file = None
        for row, inputs in stream:
            assert inputs is not None  # without `on_bad_scan`, a bad scan is an error
            if file is None:
                shape = (len(recording), *inputs.shape)
                file = np.lib.format.open_memmap(temporary, mode="w+", dtype=inputs.dtype, shape=shape)
            _require_alike(inputs, file[0], name=f"scan {recording.ids[row]} of sequence {recording.name}")
            file[row] = inputs
        del file  # flushes it


def _require_alike(inputs: np.ndarray, expected: np.ndarray, *, name: str) -> None:
    if (inputs.shape, inputs.dtype) != (expected.shape, expected.dtype):
        raise ValueError(
            f"{name}: expected an input {expected.dtype} {expected.shape} as for the other scans, found "
            f"{inputs.dtype} {inputs.shape}"
        )


def _identity(method: LearnedMethod, recording: Recording) -> str:
    """Identify the inputs: the files of a recording, their read options, and the file that declares `prepare`."""
    paths = [path for path in (*recording.paths, *recording.label_paths, *recording.containers) if path is not None]
    stats = [path.stat() if path.exists() else None for path in paths]  # None for a scan inside another file
    stamps = [None if stat is None else (stat.st_size, stat.st_mtime_ns) for stat in stats]
    files = [(str(path.absolute()), stamp) for path, stamp in zip(paths, stamps, strict=True)]
    mountings = [str(recording.mounting_of(row)) for row in range(len(recording))]
    code = hashlib.sha256(Path(inspect.getfile(method.prepare)).read_bytes()).hexdigest()
    source = [method.name, code, recording.name, recording.read_options, files, mountings]
    if not recording.on_disk and recording.positions is not None:  # a simulated recording has no files
        source.append(recording.positions.tolist())
    return hashlib.sha256(json.dumps(source).encode()).hexdigest()[:16]
