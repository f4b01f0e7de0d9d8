"""An index for more places than fit into memory, with the interface of `Index`, based on LanceDB (extra `fleet`).

A table is stored in a folder or in object storage, without a server. The answers are exact: LanceDB compares all rows
in float32, and the distances of a few additional rows are recomputed in float64.
"""

import contextlib
import json
from collections.abc import Iterable, Iterator, Sequence
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

from sglpr_jax.fields import Size
from sglpr_jax.files import in_short, naming, parse_json
from sglpr_jax.retrieval.descriptor_file import DescriptorFile
from sglpr_jax.retrieval.index_rows import (
    MOST,
    Found,
    check_asked,
    check_weights,
    checked_rows,
    given_flags,
    nearest_of,
    new_places,
    places_of,
)
from sglpr_jax.revisits import EXCLUDED_FRAMES, EXCLUDED_S, are_recent
from sglpr_jax.schema import check_about

FORMAT = "sglpr-jax fleet index 1"
"""Format in every table."""
ABOUT = {"width": Size, "weights_hash": str}
"""JSON values in the metadata of every table."""
TABLE = "places"
SPARE = 16
"""Number of additional rows compared in float64, because float32 may swap rows with almost equal distances."""


class FleetIndex:
    """Index of place descriptors in a folder or bucket that several processes share. Row i is the i-th place that was
    added.

    Descriptors are compared by L2. Any number of processes may query while one adds. Each answer includes all places
    that existed at the time of the query.

    Example:
      index = FleetIndex("s3://bucket/town", weights_hash=file.weights_hash)   # or a folder
      index.add_file(file)
      rows, distances = index.query(descriptor, 3)
    """

    distance = "l2"

    def __init__(self, place: Path | str, *, width: int = 256, weights_hash: str | None = None):
        """Open a table in a folder or in object storage. If there is no table, the first `add` creates it.

        Arguments:
          place: Folder, or address in object storage.
          width: Length of a descriptor.
          weights_hash: Hash of the weights that the table must have. None accepts any weights.

        Raises:
          ImportError: If the extra `fleet` is not installed.
          ValueError: If the table is not an index, or has another width or other weights.
        """
        self.place = str(place)
        self._connection = _connect(self.place)
        self.width, self.weights_hash = width, weights_hash or ""
        self.table: Any = _open(self._connection, self.place)
        """LanceDB's table, for its other functions. None while the index is empty."""
        if self.table is not None:
            self._check_about(weights_hash)

    def __len__(self) -> int:
        with _intact(self.place):
            return 0 if self.table is None else self.table.count_rows()

    @property
    def ids(self) -> list[str]:
        """Names of all places. Reads the whole column."""
        return self._column("id").tolist()

    @property
    def times(self) -> Float[np.ndarray, " n"] | None:
        """Times of all places in seconds, or None if they have no times."""
        return self._column("time") if "time" in self._names() else None

    @property
    def positions(self) -> Float[np.ndarray, "n 3"] | None:
        """Positions of all places in metres, z up, or None if they have no positions."""
        return np.stack(list(self._column("position"))) if "position" in self._names() else None

    def add(
        self,
        descriptors: ArrayLike,
        *,
        ids: Sequence[str] | str | None = None,
        times: ArrayLike | float | None = None,
        positions: ArrayLike | None = None,
        weights_hash: str | None = None,
    ) -> None:
        """Add places like `Index.add`, atomically. Adding many places at once is faster than one by one."""
        check_weights(self.weights_hash, weights_hash)
        first = len(self)
        before = [named for named, stored in _STORED.items() if stored in self._names()]
        about = {"ids": ids, "times": times, "positions": positions}
        names, columns = new_places(descriptors, width=self.width, first=first, before=before, **about)
        if not names:  # An empty call creates no columns.
            return
        rows = self._arrow(first, names, columns)
        if self.table is None:
            self.table = self._connection.create_table(TABLE, rows)
        else:
            self.table.add(rows)

    def add_file(self, file: DescriptorFile) -> None:
        """Add the places of a descriptor file. Raises ValueError if another model or method made it."""
        self.add(**places_of(file, distance=self.distance))

    def query(
        self,
        descriptors: ArrayLike,
        k: int = 1,
        *,
        exclude: ArrayLike | None = None,
        weights_hash: str | None = None,
    ) -> Found:
        """Find the nearest `k` places of one descriptor (d,) or of several (q, d), like `Index.query`.

        If `exclude` has fewer flags than there are places, it covers the first places. Places that another process
        added later are not excluded. A few runs of flags, such as those of `recent`, cost little, but thousands of runs
        are slow.
        """
        check_weights(self.weights_hash, weights_hash)
        queries = checked_rows(descriptors, self.width)
        excluded = given_flags(exclude)
        places = MOST if excluded is None and 1 <= k <= MOST else len(self)  # counting the places of a table takes time
        places = places if excluded is None else min(places, excluded.size)
        check_asked(k, excluded, queries=len(queries), places=places)
        rows = np.full((len(queries), k), -1)
        distances = np.full((len(queries), k), np.inf)
        where = "" if excluded is None else _without(excluded)
        for i, query in enumerate(queries if self.table is not None else ()):
            near, vectors = self._candidates(query, k + SPARE, where)
            found, apart = nearest_of(query, vectors, near, k)
            rows[i, : len(found)], distances[i, : len(found)] = found, apart
        shape = (*np.shape(descriptors)[:-1], k)
        return Found(rows.reshape(shape), distances.reshape(shape))

    def recent(
        self, now: float | None = None, *, seconds: float = EXCLUDED_S, frames: int = EXCLUDED_FRAMES
    ) -> Bool[np.ndarray, " n"]:
        """Return which places are too recent to be a revisit. See `Index.recent`."""
        return are_recent(len(self), None if now is None else self.times, now, seconds=seconds, frames=frames)

    def _candidates(self, query: Float[np.ndarray, " d"], k: int, where: str) -> tuple[np.ndarray, np.ndarray]:
        """Return the rows and descriptors of the nearest k places by LanceDB, without its approximate index."""
        search = self.table.search(query).distance_type("l2").bypass_vector_index()
        search = search.where(where, prefilter=True) if where else search
        with _intact(self.place):
            found = search.select(["row", "descriptor", "_distance"]).limit(k).to_arrow()
            rows, vectors = found["row"].to_numpy(), found["descriptor"].combine_chunks().flatten().to_numpy()
            if (rows < 0).any() or len(np.unique(rows)) < len(rows) or not np.isfinite(vectors).all():
                raise ValueError("rows that are no places")
            return rows, vectors.reshape(-1, self.width)

    def _arrow(self, first: int, ids: list[str], columns: dict[str, np.ndarray]) -> Any:
        """Return rows as an Arrow table for LanceDB. The schema contains the metadata of the index."""
        import pyarrow

        def vectors(values: np.ndarray) -> Any:
            return pyarrow.FixedSizeListArray.from_arrays(pyarrow.array(values.reshape(-1)), values.shape[1])

        stored = {
            _STORED[name]: vectors(values) if values.ndim > 1 else pyarrow.array(values)
            for name, values in columns.items()
        }
        rows = {"row": pyarrow.array(np.arange(first, first + len(ids))), "id": pyarrow.array(ids, pyarrow.string())}
        about = {"format": FORMAT, "width": self.width, "weights_hash": self.weights_hash}
        return pyarrow.table({**rows, **stored}).replace_schema_metadata({"about": json.dumps(about)})

    def _check_about(self, weights_hash: str | None) -> None:
        """Read the metadata and columns of the table. Raises ValueError if they are invalid or contradict the
        arguments."""
        with _intact(self.place):
            schema = self.table.schema
        text = (schema.metadata or {}).get(b"about", b"null")
        about = parse_json(text, source=f"{self.place}, `about`")
        with naming(self.place):
            check_about(about, ABOUT, format=FORMAT)
            if about["width"] != self.width:
                raise ValueError(f"expected descriptors of {self.width} numbers, found {about['width']}")
            check_weights(about["weights_hash"], weights_hash)
            _check_types({field.name: str(field.type) for field in schema}, self.width)
        self.weights_hash = about["weights_hash"]

    def _names(self) -> list[str]:
        return [] if self.table is None else self.table.schema.names

    def _column(self, name: str) -> np.ndarray:
        if self.table is None:
            return np.empty(0)
        with _intact(self.place):
            found = self.table.search().select(["row", name]).limit(None).to_arrow()
            rows, values = found["row"].to_numpy(), found[name]
            order = np.argsort(rows)
            if values.null_count or not np.array_equal(rows[order], np.arange(len(rows))):
                raise ValueError(f"places without a row or {name}")
            return values.to_numpy()[order]


_STORED = {"descriptors": "descriptor", "times": "time", "positions": "position"}
"""Table columns for the columns of `NewPlaces`."""


def _check_types(found: dict[str, str], width: int) -> None:
    """Raise ValueError if a column is missing or has another type. Columns of other names are ignored."""
    needed = {"row": ("int64",), "id": ("string",), "descriptor": _vector_types("float", width)}
    known = needed | {"time": ("double",), "position": _vector_types("double", 3)}
    for name, types in known.items():
        if found.get(name, types[0] if name not in needed else "none") not in types:
            raise ValueError(f"expected a column {name} of {types[0]}, found {found.get(name, 'none')}")


def _vector_types(kind: str, size: int) -> tuple[str, ...]:
    """Names of Arrow's type of a vector. Its versions name the item differently."""
    return tuple(f"fixed_size_list<{item}: {kind}>[{size}]" for item in ("item", "element"))


def _without(exclude: Bool[np.ndarray, " n"]) -> str:
    """SQL condition that excludes the given rows, run by run."""
    return " AND ".join(f"NOT (row BETWEEN {first} AND {last})" for first, last in _runs(exclude))


def _runs(flags: Bool[np.ndarray, " n"]) -> Iterable[tuple[int, int]]:
    """First and last index of each run of set flags."""
    steps = np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8))
    return zip(np.flatnonzero(steps == 1).tolist(), (np.flatnonzero(steps == -1) - 1).tolist(), strict=True)


def _connect(place: str) -> Any:
    try:
        import lancedb
    except ImportError as error:
        raise ImportError(f"{place}: this index needs the extra `fleet` (pip install 'sglpr-jax[fleet]')") from error
    return lancedb.connect(place, read_consistency_interval=timedelta(0))


def _open(connection: Any, place: str) -> Any:
    """Return the table, or None if it does not exist yet."""
    if TABLE not in connection.list_tables().tables:
        return None
    with _intact(place):
        return connection.open_table(TABLE)


@contextlib.contextmanager
def _intact(place: str) -> Iterator[None]:
    """Convert exceptions of LanceDB to a ValueError that names the index. It raises many types for damaged files."""
    try:
        yield
    except Exception as error:
        raise ValueError(f"{place}: expected an index of LanceDB, found a broken one ({in_short(error)})") from error
