"""Recipes for Ray: places of the recordings of a fleet, and loops between those that may overlap.

    pip install '.[fleet]' 'ray[data]'
    python -m benchmarks fleet embed 's3://bucket/recordings/*' --out s3://bucket/places
    python -m benchmarks fleet loops s3://bucket/places s3://bucket/index found

Both commands can be repeated: what is done is not done again.
"""

import contextlib
import os
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import fsspec
import numpy as np
import tyro

import sglpr_jax
from sglpr_jax.files import replacing
from sglpr_jax.methods.registry import network
from sglpr_jax.pose_graph.folder import write_loop_folder
from sglpr_jax.retrieval.fleet_index import FleetIndex
from sglpr_jax.retrieval.parquet import embed_to_store, read_places, stored_places

if TYPE_CHECKING:
    import pyarrow

BLOCK, NEAREST = 256, 10
"""Scans that are searched at a time, and places that are found for each."""
MAX_DISTANCE, MIN_SCANS = 0.8, 5
"""Recordings may overlap if MIN_SCANS scans of one have a descriptor of the other within MAX_DISTANCE."""


def embed(
    recordings: tyro.conf.Positional[str], *, out: str, weights: str = "sglpr", site: str = "", workers: int = 2
) -> None:
    """Describe recordings on the Ray cluster of `RAY_ADDRESS`, or else on this machine.

    Args:
        recordings: pattern of the addresses of recordings, a folder or a bag each.
        out: store of places.
        weights: name of shipped weights, or a folder.
        site: where the recordings were made.
        workers: number of processes that hold a model.
    """
    filesystem, pattern = fsspec.core.url_to_fs(recordings)
    sources = [filesystem.unstrip_protocol(path) for path in sorted(filesystem.glob(pattern))]
    if not sources:
        raise SystemExit(f"{recordings}: expected recordings, found none")
    rows = [{"source": source} for source in sources]
    found = in_actors(Describer, rows, workers=workers, out=out, weights=weights, site=site)
    failed = [row for row in found if row["error"]]
    added = sum(row["added"] for row in found)
    print(f"{len(found)} recordings: {added} places added to {out}, {len(failed)} recordings failed")
    for row in failed:
        print(f"{row['source']}: {row['error']}")


def in_actors(worker: type, rows: Sequence[dict[str, Any]], *, workers: int, **about: Any) -> list[dict[str, Any]]:
    """Map rows by actors `worker(**about)` of Ray Data. If a worker dies, Ray starts another, which repeats its row."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    import ray.data

    data = ray.data.from_items(list(rows), override_num_blocks=len(rows))
    pool = ray.data.ActorPoolStrategy(size=workers)
    return data.map(worker, fn_constructor_kwargs=about, compute=pool).take_all()


class Describer:
    """Describes one recording after the other with a model that is compiled once."""

    def __init__(self, *, out: str, weights: str = "sglpr", site: str = ""):
        self.out, self.site, self.method = out, site, network(sglpr_jax.load(weights))

    def __call__(self, row: dict[str, Any]) -> dict[str, Any]:
        """Describe the recording `row["source"]`. An unreadable recording is reported and does not stop the others."""
        try:
            with local_copy(row["source"]) as path:
                recording = sglpr_jax.open_recording(path)
                address, added = embed_to_store(self.out, self.method, recording, site=self.site, source=row["source"])
            return row | {"address": address, "added": added or 0, "error": ""}
        except (OSError, ValueError) as error:
            return row | {"address": "", "added": 0, "error": str(error)}


@contextlib.contextmanager
def local_copy(source: str) -> Iterator[Path]:
    """A recording as files on this machine. A copy from object storage is removed at the end."""
    filesystem, path = fsspec.core.url_to_fs(source)
    if filesystem.protocol == "file" or "file" in filesystem.protocol:
        yield Path(path)
        return
    with tempfile.TemporaryDirectory() as folder:
        local = Path(folder) / Path(path).name
        filesystem.get(path, str(local), recursive=True)
        yield local


def loops(
    places: tyro.conf.Positional[str],
    index: tyro.conf.Positional[str],
    out: tyro.conf.Positional[Path],
    *,
    weights: str = "sglpr",
    where: str = "",
    workers: int = 2,
) -> None:
    """Search the proposed pairs on the Ray cluster of `RAY_ADDRESS`, or else on this machine.

    Args:
        places: store of places.
        index: index of these places.
        out: folder of the results, one folder for each pair, which all workers can write.
        weights: weights that made the places.
        where: condition in SQL on the recordings, such as "site = 'berlin'".
        workers: number of processes.
    """
    pairs = proposed(places, index, where=where)
    todo = [pair for pair in pairs if not (out / pair["pair"]).exists()]
    print(f"{len(pairs)} pairs of recordings may overlap, {len(todo)} of them are searched now")
    if todo:
        for row in in_actors(PairSearch, todo, workers=workers, out=str(out), weights=weights):
            print(f"{row['first']} and {row['second']}: {row['said']}")


def proposed(places: str, index: str, *, where: str = "") -> list[dict[str, Any]]:
    """Add the places of a store to an index. Returns the pairs of recordings that may overlap, with their addresses."""
    fleet, sources = FleetIndex(index), {}
    for address in stored_places(places):
        rows = read_places(address)
        fleet.add(rows)
        sources[rows["recording"][0].as_py()] = rows["source"][0].as_py()
    fleet.optimize()
    found = set[tuple[str, str]]().union(*(overlaps(fleet, read_places(one), where) for one in stored_places(places)))
    return [
        {"pair": f"{a}--{b}", "first": sources[a], "second": sources[b]}
        for a, b in sorted(found)
        if a in sources and b in sources
    ]


def overlaps(index: FleetIndex, rows: "pyarrow.Table", where: str) -> set[tuple[str, str]]:
    """Pairs of recordings, by name, that may overlap with the one recording of `rows`: `MIN_SCANS` scans are near."""
    own = rows["recording"][0].as_py()
    condition = f"recording != '{own.replace(chr(39), 2 * chr(39))}'" + (f" AND ({where})" if where else "")
    pairs = set[tuple[int, str]]()
    descriptors = np.stack(rows["descriptor"].to_numpy())
    for start in range(0, len(descriptors), BLOCK):
        found = index.query(descriptors[start : start + BLOCK], NEAREST, where=condition, columns=["recording"])
        near = found["distance"].to_numpy() <= MAX_DISTANCE
        queries, others = found["query"].to_numpy()[near] + start, found["recording"].to_numpy()[near]
        pairs |= set(zip(queries.tolist(), others.tolist(), strict=True))
    scan_counts = Counter(other for _, other in pairs)
    return {(min(own, other), max(own, other)) for other, scans in scan_counts.items() if scans >= MIN_SCANS}


class PairSearch:
    """Searches one pair of recordings after the other with weights that are loaded once."""

    def __init__(self, *, out: str, weights: str):
        self.out, self.params = out, sglpr_jax.load(weights)

    def __call__(self, row: dict[str, Any]) -> dict[str, Any]:
        """Search the loops within and between two recordings, and write the files of `bin/loops`."""
        with local_copy(row["first"]) as first, local_copy(row["second"]) as second:
            recordings = [sglpr_jax.open_recording(path) for path in (first, second)]
            found = sglpr_jax.find_loops(recordings, self.params)
            with replacing(Path(self.out) / row["pair"]) as folder:
                write_loop_folder(found, folder)
        return row | {"said": str(found).splitlines()[-1].partition(": ")[2]}  # without the names of the recordings
