"""An index of the places of a fleet: a LanceDB table in a folder or in object storage (extra `fleet`)."""

from collections.abc import Sequence
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from sglpr_jax.files import naming
from sglpr_jax.retrieval.descriptor_file import check_made_alike
from sglpr_jax.retrieval.index import check_result_count, descriptor_rows
from sglpr_jax.retrieval.parquet import KEY, about_of, storage_errors

if TYPE_CHECKING:
    import pyarrow

TABLE = "places"


class FleetIndex:
    """Index of place descriptors, compared by L2, that any number of processes fill and query.

    Example:
      index = FleetIndex("s3://bucket/index", weights_hash=file.weights_hash)   # or a folder
      index.add(place_rows(file, "town-1", site="berlin"))
      near = index.query(descriptor, 3, where="site = 'berlin' AND recording != 'town-1'")
    """

    def __init__(self, address: Path | str, *, weights_hash: str | None = None, **options: Any):
        """Open a table. If there is no table, the first `add` creates it.

        Arguments:
          address: Folder, or address in object storage.
          weights_hash: Hash of the weights that the table must have, otherwise ValueError. None accepts any.
          options: Options of `lancedb.connect`, such as `storage_options` with keys of the object storage.
        """
        self.address, self.weights_hash = str(address), weights_hash
        with storage_errors(self.address):
            import lancedb

            self._connection = lancedb.connect(self.address, read_consistency_interval=timedelta(0), **options)
        self.table: Any = None  # until the first `add` of any process
        self._open()

    def __len__(self) -> int:
        self._open()
        with storage_errors(self.address):
            return 0 if self.table is None else self.table.count_rows()

    @property
    def about(self) -> dict[str, Any]:
        """Width, scale and hash of the weights of the places."""
        return about_of(self._opened().schema, self.address)

    def add(self, rows: "pyarrow.Table") -> int:
        """Add the rows of `place_rows` or of a Parquet file, all or none. Returns the number of rows that were new."""
        self._open()
        self._check(about_of(rows.schema, "rows"))
        with storage_errors(self.address):
            if self.table is None:
                self.table = self._connection.create_table(TABLE, schema=rows.schema, exist_ok=True)
            insertion = self.table.merge_insert(KEY).when_not_matched_insert_all()
            return insertion.execute(rows, timeout=timedelta(seconds=60)).num_inserted_rows

    def query(
        self,
        descriptors: ArrayLike,
        k: int = 1,
        *,
        where: str = "",
        columns: Sequence[str] = (),
        probes: int | None = 64,
        refine: int = 20,
    ) -> "pyarrow.Table":
        """Find the nearest `k` places of one descriptor (d,) or of several (q, d).

        Arguments:
          descriptors: Descriptors of the weights of the index.
          k: Number of places for each descriptor.
          where: Condition in SQL on the columns of the table. Only places that fulfil it are searched.
          columns: Further columns of the answer, such as "time" and "x".
          probes: Number of partitions of the index that are searched. None compares all places exactly.
          refine: Number of places, for each of the k, that are compared by their full descriptors.

        Returns:
          Columns `place` (recording/scan), `query` (row of the query) and `distance`, nearest first.
        """
        table = self._opened()
        queries = descriptor_rows(descriptors, table.schema.field("descriptor").type.list_size)
        check_result_count(k, queries=len(queries), places=k)
        with storage_errors(self.address):
            vectors = list(queries) if len(queries) > 1 else queries[0]
            search = table.search(vectors, vector_column_name="descriptor")
            search = search.distance_type("l2").select([KEY, *columns, "_distance"]).limit(k)
            search = search.where(where, prefilter=True) if where else search
            search = search.bypass_vector_index() if probes is None else search.nprobes(probes).refine_factor(refine)
            answers = search.to_arrow()
        query = answers["query_index"].to_numpy() if len(queries) > 1 else np.zeros(len(answers), np.int32)
        distance = np.sqrt(np.maximum(answers["_distance"].to_numpy(), 0))
        answers = answers.select([KEY, *columns]).append_column("query", [query]).append_column("distance", [distance])
        return answers.sort_by([("query", "ascending"), ("distance", "ascending"), (KEY, "ascending")])

    def optimize(self, config: Any = None) -> None:
        """Train an index for each column that has none, merge small files, and add new places to the indexes. With a
        `config` of LanceDB for the index of descriptors, all indexes are trained again."""
        from lancedb.index import Bitmap, BTree, IvfSq

        table, columns = self._opened(), {KEY: BTree(), "recording": BTree(), "time": BTree(), "site": Bitmap()}
        with storage_errors(self.address):
            trained = {column for index in table.list_indices() for column in index.columns}
            indexes = columns | {"descriptor": config or IvfSq(distance_type="l2")}
            for name, index in indexes.items():
                if config is not None or name not in trained:
                    table.create_index(name, config=index)
            table.optimize()

    def _open(self) -> None:
        """Open the table if a process has created it. Raises ValueError if it has other weights than `weights_hash`."""
        if self.table is not None:
            return
        with storage_errors(self.address):
            try:
                table = self._connection.open_table(TABLE)
            except ValueError as error:  # no process has created it, or its first version is not written yet
                if "was not found" not in str(error):
                    raise
                return
        self._check(about_of(table.schema, self.address))
        self.table = table

    def _opened(self) -> Any:
        """Return the table. Raises ValueError if no process has added places."""
        self._open()
        if self.table is None:
            raise ValueError(f"{self.address}: expected an index with places, found none")
        return self.table

    def _check(self, about: dict[str, Any]) -> None:
        """Raise ValueError if places have another width, scale or weights than the table, or than `weights_hash`."""
        expected = dict(about if self.table is None else self.about)
        if self.weights_hash is not None:
            expected["weights_hash"] = self.weights_hash
        with naming(self.address):
            check_made_alike(expected, about, of="places")
