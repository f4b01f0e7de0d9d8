"""Index of place descriptors in memory, with exact search for the nearest places and a file format.

A query takes time in proportion to the number of places; adding a place does not, and nothing is compiled.
"""

import dataclasses
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
from sglpr_jax.data.formats.tensors import hash_of, tensors_as_bytes
from sglpr_jax.fields import Size, check_value
from sglpr_jax.files import in_short, naming, parse_json, write_bytes
from sglpr_jax.growing import GrowingArray
from sglpr_jax.retrieval.descriptor_file import COLUMNS, DescriptorFile, check_made_alike
from sglpr_jax.retrieval.distances import distance_function, smallest
from sglpr_jax.same_place import EXCLUDED_FRAMES, EXCLUDED_S
from sglpr_jax.schema import check_about, check_columns

FORMAT = "sglpr-jax index 1"
"""Format in every file."""
ABOUT = {"width": Size, "weights_hash": str, "distance": str, "scale": Scale, "ids": list}
"""JSON values in the header of every file. Older files have no scale, which is 1."""
SPARE_ROWS = 16
"""Number of rows beyond k that are compared in float64, because float32 may swap rows with almost equal distances."""
GATHER_FRACTION = 1 / 4
"""If at most this fraction of the places is allowed, only their descriptors are compared with the queries."""
QUERY_BLOCK = 64
"""Number of queries compared with the places at a time, to limit memory."""
MAX_K = 2**20
"""Maximum number of places returned for a query, unless the index has more places."""
MAX_RESULTS = 2**26
"""Maximum number of places returned for all queries of a call: 1 GiB of rows and distances. A single query may have
more."""


class NearestPlaces(NamedTuple):
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
    scale: Scale = 1
    """Scale of the described scans (`data.scaled`)."""
    _last_query: tuple[bytes, Float[np.ndarray, "1 n"]] | None = dataclasses.field(default=None, repr=False)
    """Bytes of the last single query, and the result of `_relative_squared_distances`. None after places change."""

    def __post_init__(self):
        self._lengths = GrowingArray(_squared_lengths(self.descriptors))

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
        """Add one place or several. Either all places of an index have times or none, and likewise positions.

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
        new_descriptors = descriptor_rows(descriptors, self.width)
        n = len(new_descriptors)
        if ids is None:
            new_ids = [f"{row:06d}" for row in range(len(self), len(self) + n)]
        else:
            new_ids = [ids] if isinstance(ids, str) else [str(name) for name in ids]
        if len(new_ids) != n:
            raise ValueError(f"expected {n} ids, one per descriptor, found {len(new_ids)}")
        new_columns = {"descriptors": new_descriptors}
        if times is not None:
            new_columns["times"] = _finite_array("times", np.reshape(times, -1), (n,))
        if positions is not None:
            new_columns["positions"] = _finite_array("positions", np.reshape(positions, (-1, 3)), (n, 3))
        if not len(self):  # also after `keep`
            self._columns = {"descriptors": self._columns["descriptors"]}
        elif set(new_columns) != set(self._columns):
            existing, found = ", ".join(self._columns), ", ".join(new_columns)
            raise ValueError(f"expected places with {existing}, like the existing places, found {found}")
        if not n:  # a new column would require all later places to have it
            return
        for name, values in new_columns.items():
            self._columns.setdefault(name, GrowingArray(values[:0])).extend(values)
        self._lengths.extend(_squared_lengths(new_descriptors))
        self.ids += new_ids
        self._last_query = None

    def keep(self, flags: Bool[np.ndarray, " n"]) -> None:
        """Keep the places whose flag is True, in order, and remove the others. Rows are renumbered."""
        self._last_query = None
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
    ) -> NearestPlaces:
        """Find the nearest `k` places of one descriptor (d,) or of several (q, d).

        Arguments:
          descriptors: One descriptor (d,) or several (q, d).
          k: Number of places for each descriptor.
          exclude: Flag of each place: True excludes the place from the search (see `recent`).
          weights_hash: Hash of the weights that made the descriptors. None skips the check.

        Returns:
          Rows and distances, nearest first. Equal distances keep the order of the places. Missing rows are -1.

        Raises ValueError if descriptors have another width or weights, or if there would be too many
        results (`check_result_count`).
        """
        self.check(weights=weights_hash)
        queries = descriptor_rows(descriptors, self.width)
        check_result_count(k, queries=len(queries), places=len(self))
        excluded = np.zeros(len(self), bool) if exclude is None else np.asarray(exclude)
        if excluded.dtype != bool and excluded.size:
            raise ValueError(f"expected flags (True or False) of places to exclude, found {excluded.dtype}")
        if excluded.shape != (len(self),):
            raise ValueError(f"expected one flag for each of {len(self)} places to exclude, found {excluded.shape}")
        allowed = ~excluded.astype(bool)
        rows = np.full((len(queries), k), -1)
        distances = np.full((len(queries), k), np.inf)
        count = min(k, int(allowed.sum()))
        for start in range(0, len(queries), QUERY_BLOCK):
            block = slice(start, start + QUERY_BLOCK)
            if count:
                rows[block, :count], distances[block, :count] = self._nearest(queries[block], allowed, count)
        shape = (*np.shape(descriptors)[:-1], k)
        return NearestPlaces(rows.reshape(shape), distances.reshape(shape))

    def recent(
        self, now: float | None = None, *, seconds: float = EXCLUDED_S, frames: int = EXCLUDED_FRAMES
    ) -> Bool[np.ndarray, " n"]:
        """Return flags of the places less than `seconds` older than the time `now`: too recent for a revisit. Without
        `now`, or if the places have no times, the last `frames` places are flagged."""
        if now is not None and self.times is not None:
            return self.times > now - seconds
        return np.arange(len(self)) >= len(self) - frames

    def save(self, path: Path | str) -> None:
        """Write the index to one safetensors file, atomically. Its header contains the ids and metadata as JSON."""
        write_bytes(Path(path), self.to_bytes())

    def to_bytes(self, additional: Mapping[str, np.ndarray] | None = None) -> bytes:
        """Return the content of the file that `save` writes, with additional arrays that `load_with_arrays` returns."""
        arrays = {name: values.rows for name, values in self._columns.items()} | dict(additional or {})
        about = {name: getattr(self, name) for name in ABOUT}
        text = json.dumps({"format": FORMAT, **about})
        arrays = {name: np.ascontiguousarray(values) for name, values in arrays.items()}
        return tensors_as_bytes(arrays, {"about": text, "sha256": hash_of(arrays, about=text)})

    @classmethod
    def load(cls, path: Path | str, *, weights_hash: str | None = None) -> "Index":
        """Read a file written by `save`. With `weights_hash`, the index must have these weights.

        Raises:
          FileNotFoundError: If the file does not exist.
          ValueError: If the file is damaged or no index, or if the index has other weights. The message names the file.
        """
        return cls.load_with_arrays(path, weights_hash=weights_hash)[0]

    @classmethod
    def load_with_arrays(
        cls, path: Path | str, *, weights_hash: str | None = None
    ) -> tuple["Index", dict[str, np.ndarray]]:
        """Read a file with the content of `to_bytes`: the index and its additional arrays. Errors as of `load`."""
        path = Path(path)
        about, arrays = _read_index_file(path)
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
        """Return the rows and distances (q, k) of the nearest k allowed places. At least k places must be allowed. L2
        is exact: float32 products select a few rows more than k, and their distances are recomputed in float64."""
        allowed_rows = np.flatnonzero(allowed)
        if self.distance != "l2":
            distances = distance_function(self.distance)(queries, self.descriptors[allowed_rows])
            order = smallest(distances, k)
            return allowed_rows[order], np.take_along_axis(distances, order, axis=1)
        count = min(k + SPARE_ROWS, len(allowed_rows))
        if len(allowed_rows) <= GATHER_FRACTION * len(self):
            rough = self._lengths.rows[allowed_rows] - 2 * queries @ self.descriptors[allowed_rows].T
            near_rows = allowed_rows[np.argpartition(rough, count - 1, axis=1)[:, :count]]
        else:
            rough = np.where(allowed, self._relative_squared_distances(queries), np.inf)
            near_rows = np.argpartition(rough, count - 1, axis=1)[:, :count]
        near_rows = np.sort(near_rows, axis=1)  # equal distances keep the order of the rows
        pairs = zip(queries.astype(np.float64), near_rows, strict=True)
        distances = np.stack([np.linalg.norm(query - self.descriptors[rows], axis=1) for query, rows in pairs])
        order = np.argsort(distances, axis=1, kind="stable")[:, :k]
        return np.take_along_axis(near_rows, order, axis=1), np.take_along_axis(distances, order, axis=1)

    def _relative_squared_distances(self, queries: Float[np.ndarray, "q d"]) -> Float[np.ndarray, "q n"]:
        """Return squared distances to all places minus the squared length of the query, which keeps their order. The
        result for the last single query is kept, because the loop search repeats a query with other exclusions."""
        key = queries.tobytes() if len(queries) == 1 else None
        last = self._last_query  # read once, because another thread may replace it
        if last is not None and last[0] == key:
            return last[1]
        distances = self._lengths.rows - 2 * queries @ self.descriptors.T
        self._last_query = None if key is None else (key, distances)
        return distances


def _squared_lengths(descriptors: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " n"]:
    return np.einsum("nd,nd->n", descriptors, descriptors)


def _read_index_file(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return the JSON header (`ABOUT`) and the arrays of a file. Raises ValueError if it is damaged or no index."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected an index, found {'a folder' if path.is_dir() else 'none'}")
    try:
        with safetensors.safe_open(path, framework="numpy") as file:
            metadata = file.metadata() or {}
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except Exception as error:  # also numpy's, for types that it lacks
        expected = "expected an index or a map of places"
        raise ValueError(f"{path}: {expected}, found an invalid safetensors file ({in_short(error)})") from error
    text = metadata.get("about", "")
    if metadata.get("sha256") != hash_of(arrays, about=text):
        raise ValueError(f"{path}: expected an index with a valid checksum, found a damaged one")
    about = parse_json(text, source=f"{path}, `about`")
    if isinstance(about, dict):
        about.setdefault("scale", 1)  # older files have none
    with naming(path):
        check_about(about, ABOUT, format=FORMAT)
        if not all(type(name) is str for name in about["ids"]):
            raise ValueError(f"expected `ids` as a list of strings, found {about['ids']!r:.60}")
        distance_function(about["distance"])
        check_columns(arrays, COLUMNS, n=len(about["ids"]), width=about["width"])
    return about, arrays


def descriptor_rows(descriptors: Any, width: int) -> Float[np.ndarray, "n d"]:
    """Return one descriptor or several as float32 rows. Raises ValueError for a wrong width, NaN or infinity."""
    try:
        rows = np.atleast_2d(np.asarray(descriptors, np.float32))
    except (TypeError, ValueError) as error:
        raise ValueError(f"expected descriptors of {width} numbers, found others ({in_short(error)})") from error
    return _finite_array("descriptors", rows, (len(rows), width), np.float32)


def check_result_count(k: int, *, queries: int, places: int) -> None:
    """Raise ValueError if k is not from 1 to `MAX_K` or `places`, or if several queries have more than `MAX_RESULTS`
    results."""
    if not 1 <= k <= max(MAX_K, places):
        raise ValueError(f"expected k from 1 up to {max(MAX_K, places)}, found {k}")
    if queries > 1 and queries * k > MAX_RESULTS:
        raise ValueError(f"expected at most {MAX_RESULTS // k} queries at a time for k = {k}, found {queries}")


def _finite_array(name: str, values: Any, shape: tuple[int, ...], dtype: Any = np.float64) -> np.ndarray:
    """Return `values` as an array. Raises ValueError, with `name`, for another shape, NaN or infinity."""
    values = np.asarray(values, dtype)
    if values.shape != shape:
        raise ValueError(f"expected {name} of shape {shape}, found {values.shape}")
    if not np.isfinite(values).all():
        raise ValueError(f"expected finite {name}, found NaN or infinity")
    return values
