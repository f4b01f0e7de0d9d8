"""Inputs of a learned method for all scans of recordings, computed once and stored in memory-mapped files."""

import hashlib
import importlib.metadata
import inspect
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Int, Shaped

from sglpr_jax.data.fingerprint import fingerprint
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scan_stream import SCANS_AHEAD, check_readable, require_content, scan_stream
from sglpr_jax.files import file_name, in_short, replacing
from sglpr_jax.methods.learned.method import LearnedMethod
from sglpr_jax.methods.method import LABELLED
from sglpr_jax.progress import Progress, no_progress
from sglpr_jax.training.tuples import TuplePool, positions_of


@dataclass(frozen=True, eq=False)
class TrainingInputs:
    """Recordings and the inputs of their scans."""

    recordings: tuple[Recording, ...]
    inputs: tuple[Shaped[np.ndarray, "_n ..."], ...]
    """Inputs of each recording, one for each scan."""

    def at_places(self, pool: TuplePool, places: Int[np.ndarray, " n"]) -> Shaped[np.ndarray, "n ..."]:
        """Return the inputs of places, which are numbers of a pool over these recordings."""
        return np.stack([self.inputs[pool.recording_of[place]][pool.frame_of[place]] for place in places])


def prepare_inputs(
    method: LearnedMethod, recordings: Sequence[Recording], cache: Path, *, progress: Progress = no_progress
) -> TrainingInputs:
    """Compute the inputs of all scans, or read them from the cache.

    Each recording becomes one file in the folder `cache`, which is complete or does not exist. A repeated call
    continues with the missing recordings. Raises ValueError if a recording has no poses or lacks what the method needs,
    if a scan is invalid, or if inputs differ in shape or type, and OSError if the cache cannot be written.
    """
    for recording in recordings:
        require_content(method.name, method.takes, recording, every_label=True)
        positions_of(recording)
    inputs = tuple(_cached_inputs(method, recording, cache, progress) for recording in recordings)
    for recording, recording_inputs in zip(recordings, inputs, strict=True):
        _require_same_shape(recording_inputs[0], inputs[0][0], name=f"sequence {recording.name}")
    return TrainingInputs(tuple(recordings), inputs)


def _cached_inputs(method: LearnedMethod, recording: Recording, cache: Path, progress: Progress) -> np.ndarray:
    """Return the inputs of the scans of a recording from its file in the folder `cache`. Writes a missing file."""
    path = cache / f"{method.name}-{file_name(recording.name)}-{_cache_key(method, recording)}.npy"
    if not path.is_file():
        with progress(f"prepare {recording.name}", len(recording)) as show:
            _write_inputs(path, method, recording, show)
    try:
        inputs = np.load(path, mmap_mode="r", allow_pickle=False)
    except (ValueError, EOFError) as error:
        raise ValueError(f"{path}: expected inputs, found a damaged file ({in_short(error)}); delete it") from error
    if len(inputs) != len(recording):
        raise ValueError(f"{path}: expected {len(recording)} inputs, found {len(inputs)}; delete the file")
    return inputs


def _write_inputs(path: Path, method: LearnedMethod, recording: Recording, show) -> None:
    """Write the inputs of a recording, completely or not at all. `show` receives the number of prepared scans."""
    check_readable(recording, len(recording))
    options = {"labels": method.takes in LABELLED, "ahead": SCANS_AHEAD, "on_progress": show}
    stream = scan_stream(recording, lambda row, scan: method.prepare(scan), **options)
    with replacing(path) as temporary, temporary.open("wb") as file:  # in a memory map, a full disk ends the process
        first = None
        for row, inputs in stream:
            assert inputs is not None  # without `on_bad_scan`, a bad scan is an error
            if first is None:
                first, descr = inputs, np.lib.format.dtype_to_descr(inputs.dtype)
                header = {"descr": descr, "fortran_order": False, "shape": (len(recording), *inputs.shape)}
                np.lib.format.write_array_header_1_0(file, header)
            _require_same_shape(inputs, first, name=f"scan {recording.ids[row]} of sequence {recording.name}")
            file.write(inputs.tobytes())


def _require_same_shape(inputs: np.ndarray, expected: np.ndarray, *, name: str) -> None:
    """Raise ValueError if the input of a scan differs in shape or type from that of another scan."""
    if (inputs.shape, inputs.dtype) != (expected.shape, expected.dtype):
        raise ValueError(
            f"{name}: expected an input {expected.dtype} {expected.shape} as for the other scans, found "
            f"{inputs.dtype} {inputs.shape}"
        )


def _cache_key(method: LearnedMethod, recording: Recording) -> str:
    """Return a hash of the recording, the version of this package and the source file of `prepare`.

    After a change of other sources, such as `methods/cells.py`, delete the cache.
    """
    versions = [package.version for package in importlib.metadata.distributions(name="sglpr-jax")]
    code = Path(inspect.getfile(method.prepare)).read_bytes()
    return hashlib.sha256(f"{versions[:1]} {fingerprint(recording)}".encode() + code).hexdigest()[:16]
