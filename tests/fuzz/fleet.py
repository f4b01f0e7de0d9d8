"""The index of a fleet: a folder of LanceDB, whose files have no checksums."""

from pathlib import Path
from typing import Any

from sglpr_jax.retrieval.descriptor_file import DescriptorFile
from sglpr_jax.retrieval.fleet_index import FleetIndex
from sglpr_jax.retrieval.parquet import place_rows

from .continued import files_of
from .road import DESCRIPTORS, POSITIONS, TIMES, FolderRoad, N


def fill(folder: Path) -> None:
    ids = tuple(f"{row:06d}" for row in range(N))
    file = DescriptorFile("drive", ids, POSITIONS, TIMES, DESCRIPTORS, None, {}, "ab")
    FleetIndex(folder).add(place_rows(file, "drive"))


def read_fleet(folder: Path) -> Any:
    index = FleetIndex(folder, weights_hash="ab")
    return [len(index), index.query(DESCRIPTORS, N, columns=["time", "x"])]


def as_many(found: Any) -> bool:
    """Five places, of which each query has all: the values have no checksum."""
    places, answers = found
    return places == N and len(answers) == N * N


ROADS = (
    FolderRoad("fleet", "fleet", files_of(fill), read_fleet, lambda found, files: as_many(found), cost=5, slow=True),
)
