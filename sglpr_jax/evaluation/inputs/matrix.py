"""Reader of .npy files with one descriptor per row, from any program."""

from pathlib import Path

import numpy as np
from jaxtyping import Num

from sglpr_jax.data.formats.pose_files import Trajectory
from sglpr_jax.evaluation.inputs.arrays import as_descriptors
from sglpr_jax.evaluation.inputs.positions import needed
from sglpr_jax.files import in_short, naming
from sglpr_jax.numpy_files import read_array
from sglpr_jax.retrieval.descriptor_file import DescriptorFile


def read_matrix(path: Path, trajectory: Trajectory | None, *, sequence: str, distance: str) -> DescriptorFile:
    """Read descriptors (n, d) of any real type and convert them to float32. Row i belongs to pose i.

    Raises ValueError if the array is invalid, if a row is not finite, or if the numbers of rows and poses differ.
    """
    rows = _load(path)
    trajectory = needed(path, trajectory, rows=len(rows))
    with naming(path):
        return as_descriptors(rows, trajectory, sequence=sequence, method=path.stem, distance=distance)


def _load(path: Path) -> Num[np.ndarray, "n d"]:
    """Return the array of a file. Files that need pickle are rejected."""
    expected = f"{path}: expected descriptors (n, d) as numbers"
    try:
        with path.open("rb") as stream:
            rows = read_array(stream, size=path.stat().st_size)
    except MemoryError as error:
        raise ValueError(f"{expected}, found an array larger than the memory") from error
    except Exception as error:  # numpy parses the header as Python, which can raise any exception
        raise ValueError(f"{expected}, found no valid .npy file ({in_short(error)})") from error
    if rows.ndim != 2 or rows.dtype.kind not in "fiub" or rows.size == 0:
        raise ValueError(f"{expected}, found {rows.dtype} {rows.shape}")
    return rows
