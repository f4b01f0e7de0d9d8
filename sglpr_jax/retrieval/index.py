"""An index of places: descriptors are added over time, searched for the nearest, and saved in a file.

The answers are exact: a float32 product selects a few additional rows, and their distances are recomputed in float64.
A query takes time in proportion to the number of places; adding a place does not, and nothing is compiled.
"""

import dataclasses
import hashlib
import itertools
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import safetensors
from jaxtyping import Bool, Float, Int
from numpy.typing import ArrayLike

from sglpr_jax.data.choices import Scale
from sglpr_jax.data.formats.tensors import tensors_as_bytes
from sglpr_jax.fields import Size, check_value
from sglpr_jax.files import in_short, naming, parse_json, replacing
from sglpr_jax.growing import GrowingArray
from sglpr_jax.retrieval.descriptor_file import COLUMNS, DescriptorFile, check_made_alike
from sglpr_jax.retrieval.distances import distance_function, smallest
from sglpr_jax.same_place import EXCLUDED_FRAMES, EXCLUDED_S
from sglpr_jax.schema import check_about, check_columns

FORMAT = "sglpr-jax index 1"
"""Format in every file."""
ABOUT = {"width": Size, "weights_hash": str, "distance": str, "scale": Scale, "ids": list}
"""JSON values in the header of every file. Older files have no scale, which is 1."""
SPARE = 16
"""Number of additional rows compared in float64, because float32 may swap rows with almost equal distances."""
FEW = 4
"""If at most one of this many rows is allowed, only the allowed ones are compared."""
BLOCK = 64
"""Number of queries compared with all rows at a time."""
MOST = 2**20
"""Maximum number of answers to a query, unless an index has more places."""
MOST_ANSWERS = 2**26
"""Maximum number of answers to all queries of a call: 1 GiB of rows and distances. A single query may have more."""


class Found(NamedTuple):
    """Nearest k places of each query, nearest first."""

    rows: Int[np.ndarray, "*q k"]
    """Row of each place; -1 if fewer than k places can be returned."""
    distances: Float[np.ndarray, "*q k"]
    """Descriptor distance of each place; infinite if fewer than k places can be returned."""


@dataclasses.dataclass(eq=False)
class Index:
    """Index of place descriptors in memory. Row i is the i-th place that was added.

    Example:
      index = sglpr_jax.Index.empty()
      index.add(descriptors, ids=names, times=seconds)                        # (n, 256), or one (256,)
      rows, distances = index.query(descriptor, 3, exclude=index.recent(now))  # without the last 30 s
      index.save("places.safetensors")
    """

    width: int
    """Length of a descriptor."""
    weights_hash: str
    """Hash of the weights that made the descriptors. Empty for a method without weights."""
    distance: str
    """Name in `retrieval.distances` of the function that compares two descriptors."""
    ids: list[str]
    """Names of the places."""
    _columns: dict[str, GrowingArray]
    _lengths: GrowingArray = dataclasses.field(
        default_factory=lambda: GrowingArray(np.empty(0, np.float32)), repr=False
    )
    """Squared lengths of the descriptors, up to the last query."""
    scale: Scale = 1
    """Scale of the described scans (`data.scaled`)."""
    _last: tuple[bytes, Float[np.ndarray, "1 n"]] | None = dataclasses.field(default=None, repr=False)
    """The last query and its rough distances, until places are added or removed."""

    @classmethod
    def empty(cls, width: int = 256, *, weights_hash: str = "", distance: str = "l2", scale: Scale = 1) -> "Index":
        """Create an index without places. Raises ValueError if distance or scale is unknown or `width` is below 1."""
        distance_function(distance)
        check_value(scale, Scale, "scale")
        if width < 1:
            raise ValueError(f"expected a descriptor width of 1 or more, found {width}")
        columns = {"descriptors": GrowingArray(np.empty((0, width), np.float32))}
        return cls(width, weights_hash, distance, [], columns, scale=scale)

    def without_places(self) -> "Index":
        """Create an index without places, for descriptors that can be compared with those of this index."""
        return Index.empty(self.width, weights_hash=self.weights_hash, distance=self.distance, scale=self.scale)

    @classmethod
    def of(cls, file: DescriptorFile) -> "Index":
        """Create an index from the places of a descriptor file."""
        about = {"weights_hash": file.weights_hash, "distance": file.distance, "scale": file.scale}
        index = cls.empty(file.descriptors.shape[1], **about)
        index.add(file.descriptors, ids=file.ids, times=file.times, positions=file.positions)
        return index

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def descriptors(self) -> Float[np.ndarray, "n d"]:
        """Descriptors of all places, float32. This is a view and must not be changed."""
        return self._columns["descriptors"].rows

    @property
    def times(self) -> Float[np.ndarray, " n"] | None:
        """Times of all places in seconds, or None if they have no times."""
        return self._columns["times"].rows if "times" in self._columns else None

    @property
    def positions(self) -> Float[np.ndarray, "n 3"] | None:
        """Positions of all places in metres, z up, or None if they have no positions."""
        return self._columns["positions"].rows if "positions" in self._columns else None

    @property
    def nbytes(self) -> int:
        """Number of bytes of the arrays, with their spare capacity."""
        return self._lengths.nbytes + sum(values.nbytes for values in self._columns.values())

    def add(
        self,
        descriptors: ArrayLike,
        *,
        ids: Sequence[str] | str | None = None,
        times: ArrayLike | float | None = None,
        positions: ArrayLike | None = None,
        weights_hash: str | None = None,
    ) -> None:
        """Add one place, or several in order. Either all places of an index have times, or none; so for positions.

        Arguments:
          descriptors: One descriptor (d,) or several (n, d).
          ids: Names of the places. By default their rows, such as "000052".
          times: Times in seconds.
          positions: Positions in metres, z up.
          weights_hash: Hash of the weights that made the descriptors. None skips the check.

        Raises:
          ValueError: If descriptors have another width or weights, if a value is not finite, or if the places have
            other fields than the places before.
        """
        self.check(weights=weights_hash)
        rows = checked_rows(descriptors, self.width)
        n = len(rows)
        names = [f"{row:06d}" for row in range(len(self), len(self) + n)] if ids is None else ids
        names = [names] if isinstance(names, str) else [str(name) for name in names]
        if len(names) != n:
            raise ValueError(f"expected {n} ids, one per descriptor, found {len(names)}")
        new = {"descriptors": rows}
        if times is not None:
            new["times"] = _finite("times", np.reshape(times, -1), (n,))
        if positions is not None:
            new["positions"] = _finite("positions", np.reshape(positions, (-1, 3)), (n, 3))
        if len(self) and set(new) != set(self._columns):
            before, found = ", ".join(self._columns), ", ".join(new)
            raise ValueError(f"expected places with {before}, like the existing places, found {found}")
        if not n:  # a new column would require all later places to have it
            return
        for name, values in new.items():
            self._columns.setdefault(name, GrowingArray(values[:0])).extend(values)
        self.ids += names
        self._last = None

    def keep(self, flags: Bool[np.ndarray, " n"]) -> None:
        """Remove the places without a flag. The others stay in order, with new rows."""
        self._squares()
        self._last = None
        for column in (self._lengths, *self._columns.values()):
            column.keep(flags)
        self.ids = list(itertools.compress(self.ids, flags))

    def query(
        self,
        descriptors: ArrayLike,
        k: int = 1,
        *,
        exclude: ArrayLike | None = None,
        weights_hash: str | None = None,
    ) -> Found:
        """Find the nearest `k` places of one descriptor (d,) or of several (q, d).

        Arguments:
          descriptors: One descriptor (d,) or several (q, d).
          k: Number of places for each descriptor.
          exclude: Flag of each place, whether it is excluded (see `recent`).
          weights_hash: Hash of the weights that made the descriptors. None skips the check.

        Returns:
          Rows and distances, nearest first. Equal distances keep the order of the places. Missing rows are -1.

        Raises ValueError if descriptors have another width or weights, or if too much is asked for (`check_asked`).
        """
        self.check(weights=weights_hash)
        queries = checked_rows(descriptors, self.width)
        check_asked(k, queries=len(queries), places=len(self))
        excluded = np.zeros(len(self), bool) if exclude is None else np.asarray(exclude)
        if excluded.dtype != bool and excluded.size:
            raise ValueError(f"expected flags (True or False) of places to exclude, found {excluded.dtype}")
        if excluded.shape != (len(self),):
            raise ValueError(f"expected one flag for each of {len(self)} places to exclude, found {excluded.shape}")
        allowed = ~excluded.astype(bool)
        rows = np.full((len(queries), k), -1)
        distances = np.full((len(queries), k), np.inf)
        count = min(k, int(allowed.sum()))
        for start in range(0, len(queries), BLOCK) if count else ():
            block = slice(start, start + BLOCK)
            rows[block, :count], distances[block, :count] = self._nearest(queries[block], allowed, count)
        shape = (*np.shape(descriptors)[:-1], k)
        return Found(rows.reshape(shape), distances.reshape(shape))

    def recent(
        self, now: float | None = None, *, seconds: float = EXCLUDED_S, frames: int = EXCLUDED_FRAMES
    ) -> Bool[np.ndarray, " n"]:
        """Return which places are too recent to be a revisit: those less than `seconds` old at the time `now`.

        Without times or without `now`, these are the last `frames` places.
        """
        if now is not None and self.times is not None:
            return self.times > now - seconds
        return np.arange(len(self)) >= len(self) - frames

    def save(self, path: Path | str) -> None:
        """Write the index to one safetensors file, atomically. Its header contains the ids and metadata as JSON."""
        content = self.to_bytes()
        with replacing(Path(path)) as temporary:
            temporary.write_bytes(content)

    def to_bytes(self, more: Mapping[str, np.ndarray] | None = None) -> bytes:
        """Return the content of the file that `save` writes, with additional arrays that `load_with` returns."""
        arrays = {name: values.rows for name, values in self._columns.items()} | dict(more or {})
        about = {name: getattr(self, name) for name in ABOUT}
        text = json.dumps({"format": FORMAT, **about})
        arrays = {name: np.ascontiguousarray(values) for name, values in arrays.items()}
        return tensors_as_bytes(arrays, {"about": text, "sha256": _checksum(text, arrays)})

    @classmethod
    def load(cls, path: Path | str, *, weights_hash: str | None = None) -> "Index":
        """Read a file written by `save`. With `weights_hash`, the index must have these weights.

        Raises:
          FileNotFoundError: If the file does not exist.
          ValueError: If the file is damaged or no index, or if the index has other weights. The message names the file.
        """
        return cls.load_with(path, weights_hash=weights_hash)[0]

    @classmethod
    def load_with(cls, path: Path | str, *, weights_hash: str | None = None) -> tuple["Index", dict[str, np.ndarray]]:
        """Read the output of `to_bytes`: the index, and the additional arrays. Errors are those of `load`."""
        path = Path(path)
        about, arrays = _read(path)
        columns = {name: GrowingArray(arrays.pop(name)) for name in COLUMNS if name in arrays}
        index = cls(**{name: about[name] for name in ABOUT}, _columns=columns)
        with naming(path):
            index.check(weights=weights_hash)
        return index, arrays

    def check(self, **found: Any) -> None:
        """Raise ValueError if descriptors have other `weights` (hash), `scale` or `distance`. None skips a check."""
        check_made_alike({"weights": self.weights_hash, "scale": self.scale, "distance": self.distance}, found)

    def _nearest(
        self, queries: Float[np.ndarray, "q d"], allowed: Bool[np.ndarray, " n"], k: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the rows and distances (q, k) of the nearest k allowed places. At least k places must be allowed."""
        rows = np.flatnonzero(allowed)
        if self.distance != "l2":
            distances = distance_function(self.distance)(queries, self.descriptors[rows])
            order = smallest(distances, k)
            return rows[order], np.take_along_axis(distances, order, axis=1)
        count = min(k + SPARE, len(rows))
        if len(rows) * FEW <= len(self):
            rough = self._squares()[rows] - 2 * queries @ self.descriptors[rows].T
            near = rows[np.argpartition(rough, count - 1, axis=1)[:, :count]]
        else:
            near = np.argpartition(np.where(allowed, self._rough(queries), np.inf), count - 1, axis=1)[:, :count]
        near = np.sort(near, axis=1)  # equal distances keep the order of the rows
        pairs = zip(queries.astype(np.float64), near, strict=True)
        distances = np.stack([np.linalg.norm(query - self.descriptors[row], axis=1) for query, row in pairs])
        order = np.argsort(distances, axis=1, kind="stable")[:, :k]
        return np.take_along_axis(near, order, axis=1), np.take_along_axis(distances, order, axis=1)

    def _rough(self, queries: Float[np.ndarray, "q d"]) -> Float[np.ndarray, "q n"]:
        """Return the squared distances in float32, without the squared lengths of the queries.

        Those of the last query are kept, because the loop search asks for its nearest places several times.
        """
        key = queries.tobytes() if len(queries) == 1 else None
        last = self._last  # read once, because another thread may replace it
        if last is not None and last[0] == key:
            return last[1]
        distances = self._squares() - 2 * queries @ self.descriptors.T
        self._last = None if key is None else (key, distances)
        return distances

    def _squares(self) -> Float[np.ndarray, " n"]:
        """Return the squared lengths of all descriptors, after computing those of new places."""
        new = self.descriptors[len(self._lengths) :]
        if len(new):
            self._lengths.extend(np.einsum("nd,nd->n", new, new))
        return self._lengths.rows


def _checksum(about: str, arrays: dict[str, np.ndarray]) -> str:
    digest = hashlib.sha256(about.encode())
    for name, values in sorted(arrays.items()):
        digest.update(f"{name} {values.shape} {values.dtype}".encode())
        digest.update(np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()


def _read(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return the JSON part and the arrays of an index. Raises ValueError if the file is damaged or no index."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected an index, found {'a folder' if path.is_dir() else 'none'}")
    try:
        with safetensors.safe_open(path, framework="numpy") as file:
            metadata = file.metadata() or {}
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except Exception as error:  # also numpy's, for types that it lacks
        raise ValueError(f"{path}: expected an index, found an invalid safetensors file ({in_short(error)})") from error
    text = metadata.get("about", "")
    if metadata.get("sha256") != _checksum(text, arrays):
        raise ValueError(f"{path}: expected an index with a valid checksum, found a damaged one")
    about = parse_json(text, source=f"{path}, `about`")
    about = {"scale": 1, **about} if isinstance(about, dict) else about
    with naming(path):
        check_about(about, ABOUT, format=FORMAT)
        if not all(type(name) is str for name in about["ids"]):
            raise ValueError(f"expected `ids` as a list of strings, found {about['ids']!r:.60}")
        distance_function(about["distance"])
        check_columns(arrays, COLUMNS, n=len(about["ids"]), width=about["width"])
    return about, arrays


def checked_rows(descriptors: Any, width: int) -> Float[np.ndarray, "n d"]:
    """Return one descriptor or several as float32 rows. Raises ValueError for a wrong width, NaN or infinity."""
    try:
        rows = np.atleast_2d(np.asarray(descriptors, np.float32))
    except (TypeError, ValueError) as error:
        raise ValueError(f"expected descriptors of {width} numbers, found others ({in_short(error)})") from error
    return _finite("descriptors", rows, (len(rows), width)).astype(np.float32)


def check_asked(k: int, *, queries: int, places: int) -> None:
    """Raise ValueError if k is below 1 or exceeds both `MOST` and `places`, or if the answers to several queries exceed
    `MOST_ANSWERS`."""
    if not 1 <= k <= max(MOST, places):
        raise ValueError(f"expected k from 1 up to {max(MOST, places)}, found {k}")
    if queries > 1 and queries * k > MOST_ANSWERS:
        raise ValueError(f"expected at most {MOST_ANSWERS // k} queries at a time for k = {k}, found {queries}")


def _finite(name: str, values: Any, shape: tuple[int, ...]) -> np.ndarray:
    values = np.asarray(values, np.float64 if name != "descriptors" else np.float32)
    if values.shape != shape:
        raise ValueError(f"expected {name} of shape {shape}, found {values.shape}")
    if not np.isfinite(values).all():
        raise ValueError(f"expected finite {name}, found NaN or infinity")
    return values
