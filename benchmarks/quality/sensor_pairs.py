"""Map of one sensor, queries of another: recall@1 of descriptors, and share of the queries that are relocated right.

    python -m benchmarks.quality.sensor_pairs --seeds 609 610 --out build/submaps

Each sensor drives the same street (`submaps.py`): once for the map, then once in the opposite and once in the same
direction. A query within 5 m of the map is found if the nearest descriptor is within 5 m. It is relocated right if the
first answer of `PlaceMap.relocate` is within 0.5 m (horizontally) and 2 degrees of the true pose, and wrong if its
probability is at least 0.99 and its position is more than 5 m off.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tyro
from jaxtyping import Bool, Float

import sglpr_jax
from benchmarks.quality.submaps import APART_M, PASSES, RIGHT_M, Drive, rendered, scored, submaps_of_passes
from sglpr_jax.data.scan_stream import only
from sglpr_jax.loops.candidates import CandidateFinder
from sglpr_jax.loops.keyframes import Seen
from sglpr_jax.maps.build import map_recording
from sglpr_jax.maps.place_map import PlaceMap
from sglpr_jax.se3 import distances, inverse, yaw_of

SENSORS = ("vlp16", "os0-32", "os1-64", "hdl64e", "mid360", "avia")
WELL_M, WELL_DEG = 0.5, 2.0
SURE = 0.99
QUERIES = ("opposite", "same")


class Driven(NamedTuple):
    """A map, and the queries of the other passes."""

    places: PlaceMap
    seen: Sequence[Seen]
    poses: Float[np.ndarray, "n 4 4"]
    """True pose of each query."""


def main(
    *,
    sensors: tuple[str, ...] = SENSORS,
    seeds: tuple[int, ...] = (609, 610),
    length_m: float = 0.0,
    metres: int = 110,
    spacing_m: float = 4.0,
    azimuth_steps: int = 900,
    weights: str = "sglpr",
    out: Path = Path("build/submaps"),
) -> None:
    """Print a row for each ordered pair of sensors.

    Args:
        sensors: names of `sim.SENSORS`.
        seeds: one town for each.
        length_m: length of the submaps; 0 is a single scan.
        metres: length of the street.
        spacing_m: distance between two places of a map, and between two queries.
        azimuth_steps: firings of the sensor per turn, at most.
        weights: the model that describes the scans.
        out: folder of the scans.
    """
    params = sglpr_jax.load(weights)
    found = {
        sensor: [
            prepared(params, rendered(sensor, seed, metres, azimuth_steps, out), length_m, spacing_m, seed)
            for seed in seeds
        ]
        for sensor in sensors
    }
    print("| map | query | recall@1 | right | wrong at .99 | queries |\n|---|---|---|---|---|---|")
    for mapped in sensors:
        for asked in sensors:
            pairs = [located(one, other) for one, other in zip(found[mapped], found[asked], strict=True)]
            near, right, wrong = np.concatenate(pairs, axis=1)
            shares = f"{near.mean():.3f} | {right.mean():.3f} | {wrong.sum()}"
            print(f"| {mapped} | {asked} | {shares} | {len(near)} |", flush=True)


def prepared(params: sglpr_jax.Params, drive: Drive, length_m: float, spacing_m: float, seed: int) -> Driven:
    """The map of the first pass, and the described queries of `QUERIES`."""
    recording = submaps_of_passes(drive, length_m, seed=seed)
    rows, every = np.array(scored(drive)), max(1, round(spacing_m))
    mapped = rows[drive.passes[rows] == 0]
    places = map_recording(only(recording, mapped.tolist()), params, drive.poses[mapped], spacing_m=spacing_m).places
    numbers = [list(PASSES).index(name) for name in QUERIES]
    asked = rows[np.isin(drive.passes[rows], numbers)][::every]
    finder = CandidateFinder(params)
    return Driven(places, [finder.seen(recording.record(row)) for row in asked.tolist()], drive.poses[asked])


def located(mapped: Driven, asked: Driven) -> Bool[np.ndarray, "3 n"]:
    """For each query near the map: found by its descriptor, relocated right, and relocated wrong but sure."""
    apart = distances(asked.poses[:, :2, 3], mapped.places.world_from_place[:, :2, 3])
    rows = np.flatnonzero(apart.min(axis=1) < APART_M)
    found = np.zeros((3, len(rows)), bool)
    for i, row in enumerate(rows.tolist()):
        seen, truth = asked.seen[row], asked.poses[row]
        nearest = mapped.places.index.query(seen.descriptor).rows[0]
        answers = mapped.places.relocate_seen(seen, weights_hash=mapped.places.index.weights_hash)
        found[0, i] = apart[row, nearest] <= RIGHT_M
        if answers:
            error = inverse(truth) @ answers[0].world_from_query
            metres, degrees = np.hypot(*error[:2, 3]), abs(np.degrees(yaw_of(error)))
            found[1, i] = metres < WELL_M and degrees < WELL_DEG
            found[2, i] = metres > RIGHT_M and answers[0].probability >= SURE
    return found


if __name__ == "__main__":
    tyro.cli(main)
