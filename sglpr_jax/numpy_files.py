"""Reading of numpy's .npy and .npz files without pickle. Declared sizes are checked before memory is allocated."""

import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from sglpr_jax.files import in_short


def read_arrays(path: Path, *, expected: str) -> dict[str, np.ndarray]:
    """Read every array of an .npz file, without pickle.

    Raises FileNotFoundError, or ValueError for another or a damaged file, with the file and what was `expected`.
    """
    expected = f"{path}: expected {expected}"
    if not path.is_file():
        raise FileNotFoundError(f"{expected}, found no file")
    if not zipfile.is_zipfile(path):
        raise ValueError(f"{expected}, found {path.stat().st_size} bytes that are not a complete .npz archive")
    try:
        with zipfile.ZipFile(path) as archive:
            return {member.filename.removesuffix(".npy"): _member(archive, member) for member in archive.infolist()}
    except Exception as error:  # zip, zlib and numpy raise many types of errors
        raise ValueError(f"{expected}, found a broken one: {in_short(error)}") from error


def read_array(stream: Any, *, size: int) -> np.ndarray:
    """Read an array in numpy's format, without pickle, from an open file or member of an archive of `size` bytes.

    Raises ValueError if the header declares another size, before memory is allocated. Numpy raises many types of errors
    for broken headers.
    """
    shorter = np.lib.format.read_magic(stream) == (1, 0)
    read_header = np.lib.format.read_array_header_1_0 if shorter else np.lib.format.read_array_header_2_0
    shape, _, dtype = read_header(stream)
    declared = stream.tell() + math.prod(shape) * dtype.itemsize
    if declared != size and not dtype.hasobject:  # numpy itself rejects pickled objects
        raise ValueError(f"expected {declared} bytes of data, as its header declares, found {size}")
    if not dtype.itemsize and math.prod(shape):  # any number of empty values fits into any file
        raise ValueError(f"expected values of at least one byte, found {dtype} {shape}")
    stream.seek(0)
    return np.lib.format.read_array(stream, allow_pickle=False)


def _member(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    with archive.open(member) as stream:
        try:
            return read_array(stream, size=member.file_size)
        except Exception as error:
            raise ValueError(f"array {member.filename!r}: {in_short(error)}") from error
