"""The index of a fleet: a folder of LanceDB, whose files have no checksums."""

from pathlib import Path
from typing import Any

import numpy as np

from sglpr_jax.retrieval.fleet_index import FleetIndex

from .continued import files_of
from .road import DESCRIPTORS, POSITIONS, TIMES, FolderRoad, N


def fill(folder: Path) -> None:
    index = FleetIndex(folder, width=DESCRIPTORS.shape[1], weights_hash="ab")
    index.add(DESCRIPTORS, times=TIMES, positions=POSITIONS)


def read_fleet(folder: Path) -> Any:
    index = FleetIndex(folder, width=DESCRIPTORS.shape[1], weights_hash="ab")
    found = index.query(DESCRIPTORS, N)
    return [index.ids, index.times, index.positions, found.rows, found.distances]


def as_many(found: Any) -> bool:
    """Five places, of which each query has all: the values have no checksum."""
    ids, times, positions, rows, distances = found
    shapes = np.shape(times), np.shape(positions), np.shape(distances)
    return len(ids) == N and shapes == ((N,), (N, 3), (N, N)) and np.array_equal(np.sort(rows), [range(N)] * N)


ROADS = (
    FolderRoad("fleet", "fleet", files_of(fill), read_fleet, lambda found, files: as_many(found), cost=5, slow=True),
)
