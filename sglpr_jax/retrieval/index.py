"""An index of places: descriptors that are added as they come, asked for the nearest, and kept in a file.

The answers are exact: a product of float32 chooses a few more rows than asked for, and their distances are taken
again in float64. Room for rows doubles when it is full, so that adding stays cheap and nothing is compiled.
"""

import dataclasses
import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
from jaxtyping import Bool, Float

from sglpr_jax.data.formats.tensors import tensors_as_bytes
from sglpr_jax.files import replacing
from sglpr_jax.retrieval.descriptor_file import DescriptorFile
from sglpr_jax.retrieval.distances import distance_function, smallest
from sglpr_jax.retrieval.index_rows import (
    COLUMNS,
    Found,
    check_asked,
    check_weights,
    checked_rows,
    nearest_of,
    new_places,
    places_of,
)
from sglpr_jax.revisits import EXCLUDED_FRAMES, EXCLUDED_S

FORMAT = "sglpr-jax index 1"
"""Stands in every file."""
FIRST_ROOM = 256
"""Rows that an empty index has room for."""
SPARE = 16
"""So many rows more than asked for are compared in float64: float32 may swap those that are almost equally near."""
BLOCK = 64
"""Queries compared with all rows at a time."""


@dataclasses.dataclass(eq=False)
class Index:
    """Places by their descriptors, in the order they were added: row i is the i-th.

    Example:
      index = sglpr_jax.Index.empty()
      index.add(descriptors, ids=names, times=seconds)                        # (n, 256), or one (256,)
      rows, distances = index.query(descriptor, 3, exclude=index.recent(now))  # without the last 30 s
      index.save("places.safetensors")
    """

    width: int
    """Numbers of a descriptor."""
    weights_hash: str
    """Names the weights that made the descriptors; empty for a method without any."""
    distance: str
    """The name in `retrieval.distances` of the function that compares two descriptors."""
    ids: list[str]
    """The names of the places."""
    _columns: dict[str, np.ndarray]
    _lengths: np.ndarray = dataclasses.field(default_factory=lambda: np.empty(0, np.float32), repr=False)
    """Squared; of the places that were there when the index was last asked."""

    @classmethod
    def empty(cls, width: int = 256, *, weights_hash: str = "", distance: str = "l2") -> "Index":
        """An index without places. Raises ValueError for an unknown distance."""
        distance_function(distance)
        if width < 1:
            raise ValueError(f"expected descriptors of 1 number or more, found {width}")
        return cls(width, weights_hash, distance, [], {"descriptors": np.empty((FIRST_ROOM, width), np.float32)})

    @classmethod
    def of(cls, file: DescriptorFile) -> "Index":
        """The places of a descriptor file."""
        index = cls.empty(file.descriptors.shape[1], weights_hash=file.weights_hash, distance=file.distance)
        index.add_file(file)
        return index

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def descriptors(self) -> Float[np.ndarray, "n d"]:
        """Of all places, float32; a view, not to be changed."""
        return self._columns["descriptors"][: len(self)]

    @property
    def times(self) -> Float[np.ndarray, " n"] | None:
        """Seconds, or None where the places have none."""
        return self._columns["times"][: len(self)] if "times" in self._columns else None

    @property
    def positions(self) -> Float[np.ndarray, "n 3"] | None:
        """Metres, z up, or None where the places have none."""
        return self._columns["positions"][: len(self)] if "positions" in self._columns else None

    def add(
        self,
        descriptors: Float[np.ndarray, "*n d"],
        *,
        ids: Sequence[str] | str | None = None,
        times: Float[np.ndarray, " n"] | float | None = None,
        positions: Float[np.ndarray, "*n 3"] | None = None,
        weights_hash: str | None = None,
    ) -> None:
        """Add places: one, or several in order. Without `ids` they are called by their row, as "000052".

        Either all places have times (seconds) or none, and positions (metres, z up) likewise. Raises ValueError for
        descriptors of another width or, by `weights_hash`, of another model, and for values that are not finite.
        """
        check_weights(self.weights_hash, weights_hash)
        n, about = len(self), {"ids": ids, "times": times, "positions": positions}
        names, new = new_places(descriptors, width=self.width, first=n, before=list(self._columns), **about)
        for name, values in new.items():
            self._columns[name] = _appended(self._columns.get(name), values, n)
        self.ids += names

    def add_file(self, file: DescriptorFile) -> None:
        """Add the places of a descriptor file. Raises ValueError where another model or method made it."""
        self.add(**places_of(file, distance=self.distance))

    def query(
        self,
        descriptors: Float[np.ndarray, "*q d"],
        k: int = 1,
        *,
        exclude: Bool[np.ndarray, " n"] | None = None,
        weights_hash: str | None = None,
    ) -> Found:
        """Find the nearest `k` places of one descriptor (d,) or of several (q, d).

        `exclude` says of each place whether it is left out (see `recent`). Equally near places come in the order they
        were added. Raises ValueError for descriptors of another width or, by `weights_hash`, of another model.
        """
        check_weights(self.weights_hash, weights_hash)
        queries = checked_rows(descriptors, self.width)
        check_asked(k, exclude, places=len(self))
        allowed = np.ones(len(self), bool) if exclude is None else ~exclude
        rows = np.full((len(queries), k), -1)
        distances = np.full((len(queries), k), np.inf)
        there = min(k, int(allowed.sum()))
        if there:
            for start in range(0, len(queries), BLOCK):
                block = slice(start, start + BLOCK)
                rows[block, :there], distances[block, :there] = self._nearest(queries[block], allowed, there)
        shape = (*np.shape(descriptors)[:-1], k)
        return Found(rows.reshape(shape), distances.reshape(shape))

    def recent(
        self, now: float | None = None, *, seconds: float = EXCLUDED_S, frames: int = EXCLUDED_FRAMES
    ) -> Bool[np.ndarray, " n"]:
        """Which places show where a query still is: those less than `seconds` old at the time `now`.

        Where the places have no times, or `now` is None, they are the last `frames`.
        """
        if now is not None and self.times is not None:
            return self.times > now - seconds
        return np.arange(len(self)) >= len(self) - frames

    def save(self, path: Path | str) -> None:
        """Write one file, whole or not at all: safetensors, with ids and the rest as JSON in its header."""
        content = self.to_bytes()
        with replacing(Path(path)) as temporary:
            temporary.write_bytes(content)

    def to_bytes(self, more: Mapping[str, np.ndarray] | None = None) -> bytes:
        """What `save` writes, with `more` arrays of the caller's, which `load_with` gives back."""
        arrays = {name: values[: len(self)] for name, values in self._columns.items()} | dict(more or {})
        about = {"format": FORMAT, "width": self.width, "weights_hash": self.weights_hash, "distance": self.distance}
        text = json.dumps({**about, "ids": self.ids})
        arrays = {name: np.ascontiguousarray(values) for name, values in arrays.items()}
        return tensors_as_bytes(arrays, {"about": text, "sha256": _checksum(text, arrays)})

    @classmethod
    def load(cls, path: Path | str, *, weights_hash: str | None = None) -> "Index":
        """Read what `save` wrote.

        Raises FileNotFoundError; ValueError, naming the file, where it is damaged or, by `weights_hash`, of another
        model.
        """
        return cls.load_with(path, weights_hash=weights_hash)[0]

    @classmethod
    def load_with(cls, path: Path | str, *, weights_hash: str | None = None) -> tuple["Index", dict[str, np.ndarray]]:
        """Read what `to_bytes` made: the index, and the other arrays. Errors are those of `load`."""
        path = Path(path)
        about, arrays = _read(path)
        columns = {name: arrays.pop(name) for name in COLUMNS if name in arrays}
        index = cls(about["width"], about["weights_hash"], about["distance"], about["ids"], columns)
        try:
            check_weights(index.weights_hash, weights_hash)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error
        return index, arrays

    def _nearest(
        self, queries: Float[np.ndarray, "q d"], allowed: Bool[np.ndarray, " n"], k: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """The rows and distances (q, k) of the nearest k that are `allowed`, of which there are k or more."""
        if self.distance != "l2":
            rows = np.flatnonzero(allowed)
            every = distance_function(self.distance)(queries, self.descriptors[rows])
            order = smallest(every, k)
            return rows[order], np.take_along_axis(every, order, axis=1)
        rough = self._squares()[None] - 2 * queries @ self.descriptors.T
        rough[:, ~allowed] = np.inf
        few = min(k + SPARE, int(allowed.sum()))
        near = np.argpartition(rough, few - 1, axis=1)[:, :few]
        found = [nearest_of(query, self.descriptors[row], row, k) for query, row in zip(queries, near, strict=True)]
        return np.stack([rows for rows, _ in found]), np.stack([distances for _, distances in found])

    def _squares(self) -> Float[np.ndarray, " n"]:
        """The squared lengths of all descriptors, those of new places taken now."""
        new = self.descriptors[len(self._lengths) :]
        if len(new):
            self._lengths = np.concatenate([self._lengths, np.einsum("nd,nd->n", new, new)])
        return self._lengths


def _appended(old: np.ndarray | None, new: np.ndarray, n: int) -> np.ndarray:
    """A column with room, whose rows from `n` on are the new ones."""
    room = FIRST_ROOM if old is None else max(len(old), FIRST_ROOM)
    while room < n + len(new):
        room *= 2
    if old is None or room > len(old):
        grown = np.empty((room, *new.shape[1:]), new.dtype)
        grown[:n] = old[:n] if old is not None else 0
        old = grown
    old[n : n + len(new)] = new
    return old


def _checksum(about: str, arrays: dict[str, np.ndarray]) -> str:
    digest = hashlib.sha256(about.encode())
    for name, values in sorted(arrays.items()):
        digest.update(f"{name} {values.shape} {values.dtype}".encode())
        digest.update(np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()


def _read(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The JSON part and the arrays of an index; ValueError where a byte of it is not what was written."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected an index, found {'a folder' if path.is_dir() else 'none'}")
    try:
        with safetensors.safe_open(path, framework="numpy") as file:
            metadata = file.metadata() or {}
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (safetensors.SafetensorError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: expected an index, found no whole safetensors file ({error})") from error
    text = metadata.get("about", "")
    if metadata.get("sha256") != _checksum(text, arrays):
        raise ValueError(f"{path}: expected an index as it was written, found a damaged one: its checksum is another")
    about = json.loads(text)
    if about.get("format") != FORMAT:
        raise ValueError(f"{path}: expected format {FORMAT!r}, found {about.get('format')!r}")
    return about, arrays
