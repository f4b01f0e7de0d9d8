"""Descriptor files (.npz): the descriptors of a recording by any method, with positions and times for evaluation."""

import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sglpr_jax.data.choices import SCALE, Scale
from sglpr_jax.fields import check_value
from sglpr_jax.files import json_in_short, naming, parse_json, replacing
from sglpr_jax.numpy_files import read_arrays
from sglpr_jax.retrieval.distances import distance_function
from sglpr_jax.schema import Column, check_about, check_columns

FORMAT = "sglpr-jax descriptors 2"
"""Format in every file."""
SKIPPED = "skipped"
"""Key of `config` for the rows of a recording that were skipped."""
REQUIRED = ("about", "ids", "descriptors")
ABOUT = {"sequence": str, "pose_source": str | None, "config": dict, "weights_hash": str, "distance": str}
"""Fields of `about` besides the format, and their types."""
COLUMNS = {
    "descriptors": Column("float32", ("n", "width")),
    "positions": Column("float64", ("n", 3), optional=True),
    "times": Column("float64", ("n",), optional=True),
}
"""Arrays of descriptor files and of indexes. Positions are in metres, z up, and times in seconds."""


@dataclass(frozen=True, eq=False)
class DescriptorFile:
    """Descriptors of one sequence, with everything needed to evaluate them.

    Row i of every array belongs to frame `ids[i]`, in the order of recording. Raises ValueError if the arrays have
    different numbers of rows, a value is not finite, an id is repeated, or times decrease.
    """

    sequence: str
    ids: tuple[str, ...]
    """File stems of the scans."""
    positions: np.ndarray | None
    """Positions (n, 3) float64 in metres, z up, or None without poses."""
    times: np.ndarray | None
    """Times (n,) float64 in seconds, or None if unknown."""
    descriptors: np.ndarray
    """Descriptors (n, d) float32."""
    pose_source: str | None
    """Source of `positions`, in words. Evaluations with different sources are not comparable."""
    config: dict[str, Any]
    """How the descriptors were made, as JSON data."""
    weights_hash: str
    """Hash of the weights. Empty for a method without weights."""
    distance: str = "l2"
    """Name in `retrieval.distances` of the function that compares two descriptors."""

    def __post_init__(self):
        n = len(self.ids)
        if n == 0:
            raise ValueError("expected at least one scan, found none")
        ((most_frequent, count),) = Counter(self.ids).most_common(1)
        if count > 1:
            raise ValueError(f"expected a unique id for each scan, found {most_frequent!r} {count} times")
        check_columns(self._arrays, COLUMNS, n=n)
        if self.descriptors.shape[1] == 0:
            raise ValueError(f"expected descriptors with at least one number, found {self.descriptors.shape}")
        if self.times is not None:
            backwards = np.flatnonzero(np.diff(self.times) < 0)
            if backwards.size:
                raise ValueError(f"expected times in ascending order, found an earlier time in row {backwards[0] + 1}")

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def _arrays(self) -> dict[str, np.ndarray]:
        """Arrays of the file by name, without missing ones."""
        return {name: getattr(self, name) for name in COLUMNS if getattr(self, name) is not None}

    @property
    def scale(self) -> Scale:
        """Factor for all lengths of the scans (`data.scaled`). Raises ValueError if that in `config` is invalid."""
        scale = self.config.get(SCALE, 1)
        check_value(scale, Scale, SCALE)
        return scale

    @property
    def is_described(self) -> np.ndarray:
        """Flag of each scan of the recording, skipped ones included: whether the scan is in this file. Raises
        ValueError if the skipped rows in `config` are invalid."""
        skipped = self.config.get(SKIPPED, [])
        n = len(self) + len(skipped) if isinstance(skipped, list) else 0
        valid_rows = {row for row in skipped if type(row) is int and 0 <= row < n} if n else set()
        if not n or len(valid_rows) < len(skipped):
            raise ValueError(f"expected row numbers of the skipped scans, found {skipped!r:.60}")
        return ~np.isin(np.arange(n), skipped)

    def only(self, kept: np.ndarray) -> "DescriptorFile":
        """Return the file with only the scans whose flag in `kept` is True. The others are noted as skipped."""
        is_described = self.is_described
        is_described[is_described] = kept
        config = {**self.config, SKIPPED: np.flatnonzero(~is_described).tolist()}
        arrays = {name: array[kept] for name, array in self._arrays.items()}
        return replace(self, ids=tuple(np.array(self.ids)[kept].tolist()), config=config, **arrays)

    def save(self, path: Path | str) -> None:
        """Write the file atomically. If writing fails, the previous file at `path` stays."""
        about = {"format": FORMAT, **{name: getattr(self, name) for name in ABOUT}}
        arrays: dict[str, Any] = {"about": np.array(json.dumps(about)), "ids": np.array(self.ids), **self._arrays}
        with replacing(Path(path)) as temporary, temporary.open("wb") as stream:
            np.savez(stream, **arrays)

    @classmethod
    def load(cls, path: Path | str) -> "DescriptorFile":
        """Read a file written by `save`.

        Raises:
          FileNotFoundError: If the file does not exist.
          ValueError: If the file is invalid. The message names the file, what was expected and what was found.
        """
        path = Path(path)
        arrays = read_arrays(path, expected="a descriptor file (.npz)")
        if not set(REQUIRED) <= set(arrays):
            raise ValueError(f"{path}: expected arrays {', '.join(REQUIRED)}; found {', '.join(arrays) or 'none'}")
        text, ids = arrays["about"], arrays["ids"]
        with naming(path):
            if text.ndim != 0 or text.dtype.kind != "U":
                raise ValueError(f"expected JSON in `about`, found an array {text.dtype} {text.shape}")
            about = parse_json(str(text), source="`about`")
            check_about(about, ABOUT, format=FORMAT)
            distance_function(about["distance"])
            if ids.ndim != 1 or ids.dtype.kind != "U":
                raise ValueError(f"expected ids as an array (n,) of strings, found {ids.dtype} {ids.shape}")
            return cls(
                ids=tuple(ids.tolist()),
                descriptors=arrays["descriptors"],
                positions=arrays.get("positions"),
                times=arrays.get("times"),
                **{name: about[name] for name in ABOUT},
            )


def check_made_alike(expected: Mapping[str, Any], found: Mapping[str, Any], *, of: str = "descriptors") -> None:
    """Raise ValueError if a property of descriptors, such as "weights", differs from the expected one. A property that
    is None in `found` is not checked. `of` names the descriptors in the message."""
    for name, value in found.items():
        if value is not None and value != expected[name]:
            expected_text = json_in_short(expected[name]) or "(none)"
            found_text = json_in_short(value) or "(none)"
            raise ValueError(f"expected {of} with {name} {expected_text}, found {found_text}: they are not comparable")


NETWORK_PARTS = ("backbone", "head", "categories", "detail")
"""Fields of a model for which the hash of its weights stands."""


def check_same_method(a: DescriptorFile, b: DescriptorFile) -> None:
    """Raise ValueError unless the descriptors of two files can be compared: same method, model, weights and scale. The
    recordings and the rotations may differ."""

    def properties(file: DescriptorFile) -> dict[str, Any]:
        """What must be equal in both files. A network may differ from its teacher, which has the same hash."""
        model = [file.config.get(name) for name in ("model", "grid")]
        if file.weights_hash and isinstance(model[0], dict):
            model[0] = {name: value for name, value in model[0].items() if name not in NETWORK_PARTS}
        return {
            "numbers": file.descriptors.shape[1],
            "distance": file.distance,
            "method": file.config.get("method", ""),
            "model": json.loads(json.dumps(model)),  # tuples become lists
            "weights": file.weights_hash,
            "scale": file.scale,
        }

    check_made_alike(properties(a), properties(b), of=f"descriptors of {b.sequence}, as those of {a.sequence},")
