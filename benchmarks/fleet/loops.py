"""Recipe: loops between the recordings of a fleet that may overlap, as jobs of Ray.

    python -m benchmarks.fleet.loops s3://bucket/places s3://bucket/index found

Adds new recordings to the index, proposes pairs of recordings, and searches each pair. Results that exist are kept, so
the command can be repeated. Recordings are read again from the addresses in the column `source`.
"""

import os
from pathlib import Path
from typing import Any

os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")

import tyro

import sglpr_jax
from benchmarks.fleet.embed import local_copy
from benchmarks.fleet.overlaps import overlaps
from sglpr_jax.files import replacing
from sglpr_jax.pose_graph.folder import write_several
from sglpr_jax.retrieval.fleet_index import FleetIndex
from sglpr_jax.retrieval.parquet import read_places, stored_places


def main(
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
    import ray.data

    pairs = proposed(places, index, where=where)
    todo = [pair for pair in pairs if not (out / pair["pair"]).exists()]
    print(f"{len(pairs)} pairs of recordings may overlap, {len(todo)} of them are searched now")
    if todo:
        rows = ray.data.from_items(todo, override_num_blocks=len(todo))
        pool = ray.data.ActorPoolStrategy(size=workers)
        about = {"out": str(out), "weights": weights}
        for row in rows.map(PairSearch, fn_constructor_kwargs=about, compute=pool).take_all():
            print(row["said"])


def proposed(places: str, index: str, *, where: str = "") -> list[dict[str, Any]]:
    """Add the places of a store to an index. Returns the pairs of recordings that may overlap, with their addresses."""
    fleet, sources = FleetIndex(index), {}
    for address in stored_places(places):
        rows = read_places(address)
        fleet.add(rows)
        sources[rows["recording"][0].as_py()] = rows["source"][0].as_py()
    fleet.optimize()
    found = {one[:2] for address in stored_places(places) for one in overlaps(fleet, read_places(address), where=where)}
    return [
        {"pair": f"{a}--{b}", "first": sources[a], "second": sources[b]}
        for a, b in sorted(found)
        if a in sources and b in sources
    ]


class PairSearch:
    """Searches one pair of recordings after the other with weights that are loaded once."""

    def __init__(self, *, out: str, weights: str):
        self.out, self.params = out, sglpr_jax.load(weights)

    def __call__(self, row: dict[str, Any]) -> dict[str, Any]:
        """Search the loops within and between two recordings, and write the files of `bin/loops`."""
        with local_copy(row["first"]) as first, local_copy(row["second"]) as second:
            recordings = [sglpr_jax.open_recording(path) for path in (first, second)]
            found = sglpr_jax.find_loops_between(recordings, self.params)
            with replacing(Path(self.out) / row["pair"]) as folder:
                write_several(found, folder)
        return row | {"said": str(found).splitlines()[-1]}


if __name__ == "__main__":
    tyro.cli(main)
