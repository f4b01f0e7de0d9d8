"""Reading of NumPy's .npy and .npz files without pickle. Declared sizes are checked before memory is allocated."""

import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from sglpr_jax.files import in_short


def read_arrays(path: Path, *, expected: str) -> dict[str, np.ndarray]:
    """Read every array of an .npz file, without pickle. `expected` describes the file, for messages.

    Raises FileNotFoundError, or ValueError if the file is no .npz archive, is damaged or has arrays of objects.
    """
    message = f"{path}: expected {expected}"
    if not path.is_file():
        raise FileNotFoundError(f"{message}, found no file")
    if not zipfile.is_zipfile(path):
        raise ValueError(f"{message}, found {path.stat().st_size} bytes that are not a complete .npz archive")
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            return {member.filename.removesuffix(".npy"): _read_member(archive, member) for member in members}
    except Exception as error:  # zip, zlib and numpy raise many types of errors
        raise ValueError(f"{message}, found a broken one: {in_short(error)}") from error


def read_array(stream: Any, *, size: int) -> np.ndarray:
    """Read an array in NumPy's format, without pickle, from an open file or member of an archive of `size` bytes.

    Raises ValueError if the header declares another size, before memory is allocated. NumPy raises many types of errors
    for broken headers.
    """
    is_version_1 = np.lib.format.read_magic(stream) == (1, 0)
    read_header = np.lib.format.read_array_header_1_0 if is_version_1 else np.lib.format.read_array_header_2_0
    shape, _, dtype = read_header(stream)
    declared_size = stream.tell() + math.prod(shape) * dtype.itemsize
    if declared_size != size and not dtype.hasobject:  # `read_array` below rejects pickled objects
        raise ValueError(f"expected {declared_size} bytes of data, as its header declares, found {size}")
    if not dtype.itemsize and math.prod(shape):  # any number of empty values fits into any file
        raise ValueError(f"expected values of at least one byte, found {dtype} {shape}")
    stream.seek(0)
    return np.lib.format.read_array(stream, allow_pickle=False)


def _read_member(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    """Read an array of an archive. Raises ValueError with its name for any error."""
    with archive.open(member) as stream:
        try:
            return read_array(stream, size=member.file_size)
        except Exception as error:
            raise ValueError(f"array {member.filename!r}: {in_short(error)}") from error
