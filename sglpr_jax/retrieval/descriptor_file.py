"""The descriptor file: what embedding writes and evaluation reads, whatever method made the descriptors."""

import json
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sglpr_jax.files import json_in_short, parse_json, read_arrays, replacing

FORMAT = "sglpr-jax descriptors 2"
"""Stands in every file; its number grows when an older reader could no longer understand one."""
SKIPPED = "skipped"
"""The key of `config` under which stand the rows of a recording that were left out."""
FORMAT_1 = "sglpr-jax descriptors 1"
"""Knew no distance: its descriptors are compared by L2."""

REQUIRED = ("about", "ids", "descriptors")
ABOUT = {"sequence": str, "pose_source": str | None, "config": dict, "weights_hash": str, "distance": str}
"""What stands in `about` beside the format, and of what types."""


@dataclass(frozen=True, eq=False)
class DescriptorFile:
    """The descriptors of one sequence, with all that scoring them needs.

    Row i of every array is frame `ids[i]`, in the order of recording. Raises ValueError where the numbers of rows
    differ, a value is not finite, an id stands there twice or times run backwards.
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
        twice = next((name for name, times in Counter(self.ids).items() if times > 1), None)
        if twice is not None:
            raise ValueError(f"expected an id of its own for each scan, found {twice!r} {self.ids.count(twice)} times")
        _check("descriptors", self.descriptors, np.float32, (n, None))
        if self.descriptors.shape[1] == 0:
            raise ValueError(f"expected descriptors of at least one number, found {self.descriptors.shape}")
        if self.positions is not None:
            _check("positions", self.positions, np.float64, (n, 3))
        if self.times is not None:
            _check("times", self.times, np.float64, (n,))
            backwards = np.flatnonzero(np.diff(self.times) < 0)
            if backwards.size:
                raise ValueError(f"expected times in order, found an earlier one in row {backwards[0] + 1}")

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def recorded(self) -> np.ndarray:
        """Of each scan of the recording, those too that were left out, whether it is here.

        Raises ValueError where `config` does not say it in numbers of rows.
        """
        skipped = self.config.get(SKIPPED, [])
        n = len(self) + len(skipped) if isinstance(skipped, list) else 0
        if not n or len({row for row in skipped if type(row) is int and 0 <= row < n}) < len(skipped):
            raise ValueError(f"expected the rows that were skipped, found {skipped!r:.60}")
        return ~np.isin(np.arange(n), skipped)

    def only(self, rows: np.ndarray) -> "DescriptorFile":
        """The file of those of its scans of which `rows`, a mask, says that they stay."""
        arrays = {name: getattr(self, name) for name in ("positions", "times", "descriptors")}
        chosen = {name: None if array is None else array[rows] for name, array in arrays.items()}
        recorded = self.recorded
        recorded[recorded] = rows
        config = {**self.config, SKIPPED: np.flatnonzero(~recorded).tolist()}
        return replace(self, ids=tuple(np.array(self.ids)[rows].tolist()), config=config, **chosen)

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
        arrays = read_arrays(path, expected="a descriptor file (.npz)")
        if not set(REQUIRED) <= set(arrays):
            raise ValueError(f"{path}: expected arrays {', '.join(REQUIRED)}; found {', '.join(arrays) or 'none'}")
        about = _read_about(path, arrays["about"])
        try:
            return cls(
                ids=_ids(arrays["ids"]),
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


def check_same_method(a: DescriptorFile, b: DescriptorFile) -> None:
    """Raise ValueError unless the descriptors of both files can be compared: one method, one model, the same weights.

    What the two were made of may differ: another recording, another rotation.
    """
    for what in ("numbers", "distance", "method", "model", "weights"):
        ours, theirs = _made_by(a)[what], _made_by(b)[what]
        if ours != theirs:
            raise ValueError(
                f"expected the descriptors of {b.sequence} to be made as those of {a.sequence}, with {what} "
                f"{json_in_short(ours)}, found {json_in_short(theirs)}"
            )


def _made_by(file: DescriptorFile) -> dict[str, Any]:
    config = {name: file.config.get(name) for name in ("method", "model", "grid")}
    return {
        "numbers": file.descriptors.shape[1],
        "distance": file.distance,
        "method": config["method"],
        "model": json.loads(json.dumps([config["model"], config["grid"]])),  # as a file has them: tuples are lists
        "weights": file.weights_hash,
    }


def _read_about(path: Path, text: np.ndarray) -> dict[str, Any]:
    """Return the file's JSON part; ValueError where another program or version wrote it."""
    if text.ndim != 0 or text.dtype.kind != "U":
        raise ValueError(f"{path}: expected JSON in `about`, found an array {text.dtype} {text.shape}")
    about = parse_json(str(text), source=f"{path}, `about`")
    found = about.get("format") if isinstance(about, dict) else about
    if found == FORMAT_1:
        about = {"distance": "l2", **about}
    elif found != FORMAT:
        raise ValueError(f"{path}: expected format {FORMAT!r}, found {found!r}")
    if not set(ABOUT) <= set(about):
        raise ValueError(f"{path}: expected {', '.join(f'`{name}`' for name in ABOUT)}, found {', '.join(about)}")
    for name, kind in ABOUT.items():
        if not isinstance(about[name], kind):
            raise ValueError(f"{path}: expected `{name}` as {kind}, found {about[name]!r:.60}")
    return about


def _ids(names: np.ndarray) -> tuple[str, ...]:
    """The ids of an archive; ValueError where they are no row of names."""
    if names.ndim != 1 or names.dtype.kind != "U":
        raise ValueError(f"expected ids as a row of names, found {names.dtype} {names.shape}")
    return tuple(names.tolist())
