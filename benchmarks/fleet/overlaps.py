"""Proposed pairs of recordings: those of one town, and wrong ones of different towns.

    python -m benchmarks.fleet.overlaps --seeds 11 12

Each town is driven through on two days along each route. The recordings of a town and route overlap, and those of
different ones do not.
"""

import tempfile
from collections.abc import Sequence

import numpy as np
import tyro

import sglpr_jax
from sglpr_jax.retrieval.fleet_index import FleetIndex
from sglpr_jax.retrieval.overlaps import overlaps
from sglpr_jax.retrieval.parquet import place_rows
from sglpr_jax.sim.sessions import plan_sessions

DATES = ("2026-05-01", "2026-06-01")


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
                name = f"{seed}-{route}-{session.name}"
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
