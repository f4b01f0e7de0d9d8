"""Proposed pairs of recordings: those of one town, and wrong ones of different towns.

    python -m benchmarks.fleet.overlaps --seeds 11 12

Each town is driven through on two days along each route. The recordings of a town and route overlap, and those of
different ones do not.
"""

import tempfile
from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import tyro

import sglpr_jax
from sglpr_jax.retrieval.fleet_index import FleetIndex
from sglpr_jax.retrieval.parquet import place_rows
from sglpr_jax.sim.sessions import plan_sessions

if TYPE_CHECKING:
    import pyarrow

BLOCK = 256
"""Number of scans that are searched at a time."""
DATES = ("2026-05-01", "2026-06-01")


class Overlap(NamedTuple):
    """Two recordings that may show the same places, in the order of their names."""

    recording: str
    other: str
    scans: int
    """Number of scans of one recording that have a near place in the other one."""


def overlaps(
    index: FleetIndex,
    rows: "pyarrow.Table",
    *,
    where: str = "",
    max_distance: float = 0.8,
    min_scans: int = 5,
    k: int = 10,
) -> list[Overlap]:
    """Find the recordings of an index that may overlap with one recording, most scans first.

    Arguments:
      index: Index of the fleet.
      rows: Places of one recording, from `read_places`.
      where: Condition in SQL on the other recordings, such as "site = 'berlin'".
      max_distance: Maximum distance between the descriptors of a scan and of a place near to it.
      min_scans: Minimum number of scans that have a near place in the other recording.
      k: Number of places that are found for each scan.
    """
    own = rows["recording"][0].as_py()
    condition = " AND ".join(
        [f"recording != '{own.replace(chr(39), 2 * chr(39))}'", *([f"({where})"] if where else [])]
    )
    pairs = set[tuple[int, str]]()
    descriptors = np.stack(rows["descriptor"].to_numpy())
    for start in range(0, len(descriptors), BLOCK):
        found = index.query(descriptors[start : start + BLOCK], k, where=condition, columns=["recording"])
        near = found["distance"].to_numpy() <= max_distance
        queries, others = found["query"].to_numpy()[near] + start, found["recording"].to_numpy()[near]
        pairs |= set(zip(queries.tolist(), others.tolist(), strict=True))
    counted = Counter(other for _, other in pairs)
    return [Overlap(min(own, other), max(own, other), n) for other, n in counted.most_common() if n >= min_scans]


def main(
    *,
    seeds: Sequence[int] = (11, 12),
    routes: Sequence[str] = ("00", "05", "08"),
    scans: int = 80,
    weights: str = "sglpr",
    max_distances: Sequence[float] = (0.5, 0.6, 0.7, 0.8),
) -> None:
    """Print how many pairs are proposed.

    Args:
        seeds: seeds of the towns.
        routes: routes through each town.
        scans: scans of a recording.
        weights: shipped weights, or a folder.
        max_distances: largest distances of descriptors of one place.
    """
    params, tables = sglpr_jax.load(weights), {}
    for seed in seeds:
        for route in routes:
            for session in plan_sessions(DATES, route=route, scans=scans, seed=seed):
                name = f"{seed}-{route}-{session.date}"
                tables[name] = place_rows(sglpr_jax.embed(params, session.simulate()), name)
    right = {tuple(sorted((one, one.replace(*DATES)))) for one in tables if one.endswith(DATES[0])}
    with tempfile.TemporaryDirectory() as folder:
        index = FleetIndex(folder)
        for rows in tables.values():
            index.add(rows)
        for most in max_distances:
            found = [one for rows in tables.values() for one in overlaps(index, rows, max_distance=most)]
            pairs = {(one.recording, one.other) for one in found}
            least = min((one.scans for one in found if one[:2] in right), default=0)
            others = len(tables) * (len(tables) - 1) // 2 - len(right)
            print(
                f"distance {most}: {len(pairs & right)} of {len(right)} right pairs, each by {least} scans or more; "
                f"{len(pairs - right)} wrong ones of {others}"
            )
    own = np.concatenate([_nearest(tables, one) for one in right])
    other = np.concatenate([_nearest(tables, (a, b)) for a, _ in right for _, b in right if (a, b) not in right])
    print(f"nearest distance, 50 % and 90 % of right pairs: {np.percentile(own, [50, 90]).round(2)}")
    print(f"nearest distance, 1 % and 10 % of other pairs: {np.percentile(other, [1, 10]).round(2)}")


def _nearest(tables: dict, pair: tuple[str, str]) -> np.ndarray:
    """Distance of each scan of a recording to the nearest one of another."""
    a, b = (np.stack(tables[name]["descriptor"].to_numpy()) for name in pair)
    return np.linalg.norm(a[:, None] - b[None], axis=2).min(axis=1)


if __name__ == "__main__":
    tyro.cli(main)
