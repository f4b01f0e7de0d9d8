"""The descriptor file: what embedding writes and evaluation reads, whatever method made the descriptors."""

import json
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sglpr_jax.files import replacing

FORMAT = "sglpr-jax descriptors 2"
"""Stands in every file; its number grows when an older reader could no longer understand one."""
FORMAT_1 = "sglpr-jax descriptors 1"
"""Knew no distance: its descriptors are compared by L2."""

REQUIRED = ("about", "ids", "descriptors")
ABOUT = ("sequence", "pose_source", "config", "weights_hash", "distance")


@dataclass(frozen=True, eq=False)
class DescriptorFile:
    """The descriptors of one sequence, with all that scoring them needs.

    Row i of every array is frame `ids[i]`, in the order of recording. Raises ValueError where the numbers of rows
    differ or a value is not finite.
    """

    sequence: str
    ids: tuple[str, ...]
    """File stems of the scans."""
    positions: np.ndarray | None
    """(n, 3) float64, metres, z up, or None where the source has no poses."""
    times: np.ndarray | None
    """(n,) float64 seconds, or None where the source has none."""
    descriptors: np.ndarray
    """(n, d) float32."""
    pose_source: str | None
    """Which poses `positions` are, in words: a protocol gives another number on other poses."""
    config: dict[str, Any]
    """How the descriptors were made, as JSON can hold it."""
    weights_hash: str
    """Names the weights; empty for a method without any."""
    distance: str = "l2"
    """The name in `retrieval.distances` of the function that compares two descriptors."""

    def __post_init__(self):
        n = len(self.ids)
        if n == 0:
            raise ValueError("expected at least one scan, found none")
        _check("descriptors", self.descriptors, np.float32, (n, None))
        if self.positions is not None:
            _check("positions", self.positions, np.float64, (n, 3))
        if self.times is not None:
            _check("times", self.times, np.float64, (n,))

    def __len__(self) -> int:
        return len(self.ids)

    def save(self, path: Path | str) -> None:
        """Write the file whole or not at all: a broken run leaves what was at `path` before."""
        about = {"format": FORMAT, **{name: getattr(self, name) for name in ABOUT}}
        arrays = {"descriptors": self.descriptors, "positions": self.positions, "times": self.times}
        present = {name: array for name, array in arrays.items() if array is not None}
        with replacing(Path(path)) as temporary, temporary.open("wb") as stream:
            np.savez(stream, about=np.array(json.dumps(about)), ids=np.array(self.ids), **present)

    @classmethod
    def load(cls, path: Path | str) -> "DescriptorFile":
        """Read a file that `save` wrote.

        Raises FileNotFoundError, or ValueError naming the file, what was expected and what was found.
        """
        path = Path(path)
        arrays = _read_archive(path)
        if not set(REQUIRED) <= set(arrays):
            raise ValueError(f"{path}: expected arrays {', '.join(REQUIRED)}; found {', '.join(arrays) or 'none'}")
        about = _read_about(path, arrays["about"])
        try:
            return cls(
                ids=tuple(arrays["ids"].tolist()),
                descriptors=arrays["descriptors"],
                positions=arrays.get("positions"),
                times=arrays.get("times"),
                **{name: about[name] for name in ABOUT},
            )
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error


def _check(name: str, array: np.ndarray, dtype: type, shape: tuple[int | None, ...]) -> None:
    """Raise ValueError unless `array` has this type and shape (None: any length) and is finite."""
    fits = len(array.shape) == len(shape) and all(
        want is None or want == size for want, size in zip(shape, array.shape, strict=True)
    )
    if array.dtype != dtype or not fits:
        wanted = ", ".join("any" if size is None else str(size) for size in shape)
        raise ValueError(
            f"expected {name} as {np.dtype(dtype)} ({wanted}) for {shape[0]} ids, found {array.dtype} {array.shape}"
        )
    broken = np.flatnonzero(~np.isfinite(array.reshape(len(array), -1)).all(axis=1))
    if broken.size:
        raise ValueError(f"expected finite {name}, found others in {broken.size} rows, the first in row {broken[0]}")


def _read_archive(path: Path) -> dict[str, np.ndarray]:
    """Return every array of an .npz file; one clear error for a file that is not one or is cut short."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a descriptor file, found none")
    expected = f"{path}: expected a descriptor file (.npz)"
    if not zipfile.is_zipfile(path):
        raise ValueError(f"{expected}, found {path.stat().st_size} bytes that are no whole .npz archive")
    try:
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except (ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise ValueError(f"{expected}, found a broken one: {error}") from error


def _read_about(path: Path, text: np.ndarray) -> dict[str, Any]:
    """Return the file's JSON part; ValueError where another program or version wrote it."""
    try:
        about = json.loads(str(text))
    except json.JSONDecodeError as error:
        raise ValueError(f"{path}: expected JSON in `about`, found {str(text)[:40]!r}") from error
    found = about.get("format") if isinstance(about, dict) else about
    if found == FORMAT_1:
        about = {"distance": "l2", **about}
    elif found != FORMAT:
        raise ValueError(f"{path}: expected format {FORMAT!r}, found {found!r}")
    if not set(ABOUT) <= set(about):
        raise ValueError(f"{path}: expected {', '.join(f'`{name}`' for name in ABOUT)}, found {', '.join(about)}")
    return about
