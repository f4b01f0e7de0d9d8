"""Compare the errors of poses between scans with their covariances, in simulated drives with true revisits.

    python -m benchmarks.quality.covariance
    python -m benchmarks.quality.covariance --registered --pairs 60

The normalised error squared of a pose is e^T C^-1 e. If the covariance C is right, it follows a chi-square: median 2.37
and 95 % quantile 7.81 for x, y and yaw of an aligned image; 5.35 and 12.59 for the 6 degrees of freedom of a registered
scan. A pose more than 3 m or 10 degrees off is an alias, another peak: aliases are counted, and not part of the
quantiles. No drive had a part in fitting the constants; those were fitted on seeds 200 to 207.
"""

import dataclasses
import importlib.util
from collections.abc import Iterator
from typing import NamedTuple

import jax
import numpy as np
import tyro
from jaxtyping import Float, Int
from rich.console import Console
from rich.progress import track
from rich.table import Table
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from sglpr_jax.data.levelling import upright_from_lidar
from sglpr_jax.loops.closure import Loop, planar_loop
from sglpr_jax.loops.keyframes import square_image
from sglpr_jax.registration.bev_alignment import align
from sglpr_jax.registration.gicp import register
from sglpr_jax.se3 import inverse, moved_covariance
from sglpr_jax.sim.recording import SimulatedRecording, simulate_recording
from sglpr_jax.sim.sensor import SENSORS, Sensor
from sglpr_jax.sim.styles import SCENERIES

ALIAS_M, ALIAS_DEG = 3.0, 10.0
"""Poses farther off are another peak of the correlation."""
APART_M, APART_S = 10.0, 30.0
"""The scans of a pair are at most so many metres and at least so many seconds apart."""
STEPS = {"hdl64e": 900, "hdl32e": 1080, "vlp16": 1800, "os1-64": 1024}
"""Firings per turn of each sensor."""
PLANAR = np.array([0, 1, 5])


class Drive(NamedTuple):
    """A simulated drive to take pairs from."""

    scenery: str
    route: str
    """A route of a town, or "same" or "opposite" in a repeating scenery."""
    seed: int


class Errors(NamedTuple):
    """How far the poses of one drive are off."""

    squares: Float[np.ndarray, " n"]
    """Normalised errors squared of the poses that are not aliases."""
    aliases: int
    deviations: Float[np.ndarray, " n"]
    """Largest standard deviation of the position in the plane, in metres."""


def main(
    *,
    drives: tuple[str, ...] = (
        *("town:00:300", "town:06:302", "town:08:304"),
        *("outskirts:00:301", "outskirts:08:303", "outskirts:06:305"),
        *("lanes:00:306", "gardens:06:307"),
    ),
    sensors: tuple[str, ...] = ("hdl64e", "hdl32e", "vlp16"),
    pairs: int = 80,
    scans: int = 600,
    registered: bool = False,
    repeating: bool = True,
) -> None:
    """Print a table: a row for each scenery and sensor.

    Args:
        drives: SCENERY:ROUTE:SEED.
        sensors: their names.
        pairs: of each drive.
        scans: of each drive in a town.
        registered: register the scans in 6 degrees of freedom (extra slam).
        repeating: add the sceneries that repeat, with revisits in the same and in the opposite direction.
    """
    chosen = [Drive(scenery, route, int(seed)) for scenery, route, seed in (name.split(":") for name in drives)]
    if repeating:
        chosen += list(repeating_drives())
    freedom = 6 if registered else 3
    found: dict[tuple[str, str], list[Errors]] = {}
    for sensor in sensors:
        for drive in track(chosen, description=sensor):
            lidar = dataclasses.replace(SENSORS[sensor], azimuth_steps=STEPS[sensor])
            recording = simulated(drive, lidar, scans)
            errors = errors_of(recording, pairs, np.random.default_rng(drive.seed), registered=registered)
            found.setdefault((drive.scenery, sensor), []).append(errors)
    Console(width=120).print(table_of(found, freedom))


def repeating_drives() -> Iterator[Drive]:
    """The sceneries that repeat, where this version has them."""
    if importlib.util.find_spec("sglpr_jax.sim.repeating") is not None:
        module = importlib.import_module("sglpr_jax.sim.repeating")
        for i, name in enumerate(module.REPEATING):
            yield from (Drive(name, revisit, 400 + i) for revisit in ("same", "opposite"))


def simulated(drive: Drive, lidar: Sensor, scans: int) -> SimulatedRecording:
    """The recording of a drive."""
    if drive.scenery in SCENERIES:
        scenery = SCENERIES[drive.scenery]
        return simulate_recording(drive.route, scans=scans, sensor=lidar, seed=drive.seed, scenery=scenery)
    module = importlib.import_module("sglpr_jax.sim.repeating")
    return module.simulate_repeating(drive.scenery, scans=300, seed=drive.seed, sensor=lidar, revisit=drive.route)


def revisits(recording: SimulatedRecording, count: int, rng: np.random.Generator) -> Int[np.ndarray, "n 2"]:
    """Pairs of query and match: of half the queries the nearest earlier scan, of the others one of any distance."""
    positions, times = recording.poses.world_from_lidar[:, :3, 3], recording.poses.times
    apart = np.linalg.norm(positions[:, None] - positions[None], axis=2)
    apart[(apart > APART_M) | (times[:, None] - times[None] < APART_S)] = np.inf
    queries = np.sort(rng.permutation(np.flatnonzero(np.isfinite(apart).any(axis=1)))[:count])
    wanted = np.where(rng.random(len(queries)) < 0.5, 0, rng.uniform(0, APART_M, len(queries)))
    matches = np.abs(apart[queries] - wanted[:, None]).argmin(axis=1)
    return np.stack([queries, matches], axis=1)


def errors_of(recording: SimulatedRecording, count: int, rng: np.random.Generator, *, registered: bool) -> Errors:
    """Align pairs of a recording and compare each pose with the true one."""
    poses, squares, deviations, aliases = recording.poses.world_from_lidar, [], [], 0
    for query, match in revisits(recording, count, rng).tolist():
        loop = found_loop(recording, query, match, registered=registered)
        true = inverse(poses[match]) @ poses[query]
        error = twist(inverse(true) @ loop.match_from_query)
        if np.linalg.norm(error[:2]) > ALIAS_M or np.linalg.norm(error[3:]) > np.radians(ALIAS_DEG):
            aliases += 1
            continue
        squares.append(normalised(error, loop, recording, registered=registered))
        deviations.append(np.sqrt(np.linalg.eigvalsh(loop.covariance[:2, :2])[-1]))
    return Errors(np.array(squares), aliases, np.array(deviations))


def found_loop(recording: SimulatedRecording, query: int, match: int, *, registered: bool) -> Loop:
    """The loop of two scans, by their images or, `registered`, by their points."""
    images = [square_image(recording.record(frame, labels=False)) for frame in (query, match)]
    alignment = jax.device_get(align(*images))
    mounting = recording.mounting
    loop = planar_loop(query, match, alignment, probability=1.0, query_mounting=mounting, match_mounting=mounting)
    if not registered:
        return loop
    found = register(
        recording.points(query),
        recording.points(match),
        initial=loop.match_from_query,
        initial_covariance=loop.covariance,
    )
    return dataclasses.replace(loop, match_from_query=found.match_from_query, covariance=found.covariance)


def twist(apart: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, " 6"]:
    """A small motion as metres and radians."""
    return np.concatenate([apart[:3, 3], Rotation.from_matrix(apart[:3, :3]).as_rotvec()])


def normalised(error: Float[np.ndarray, " 6"], loop: Loop, recording: SimulatedRecording, *, registered: bool) -> float:
    """e^T C^-1 e, of all 6 degrees of freedom, or of x, y and yaw on the ground."""
    covariance = loop.covariance
    if not registered:
        covariance = moved_covariance(covariance, upright_from_lidar(recording.mounting))[np.ix_(PLANAR, PLANAR)]
        error = error[PLANAR]
    return float(error @ np.linalg.inv(covariance) @ error)


def table_of(found: dict[tuple[str, str], list[Errors]], freedom: int) -> Table:
    """Median and 95 % quantile of each scenery and sensor, beside those of the chi-square."""
    median, high = chi2.ppf([0.5, 0.95], freedom)
    table = Table(
        "scenery", "sensor", "pairs", "aliases", f"median ({median:.2f})", f"95 % ({high:.2f})", "deviation, m"
    )
    for (scenery, sensor), errors in sorted(found.items()):
        squares = np.concatenate([one.squares for one in errors])
        deviations = np.concatenate([one.deviations for one in errors])
        aliases = sum(one.aliases for one in errors)
        numbers = ["", "", ""]
        if len(squares):
            numbers = [f"{np.median(squares):.2f}", f"{np.quantile(squares, 0.95):.2f}", f"{np.median(deviations):.3f}"]
        table.add_row(scenery, sensor, str(len(squares) + aliases), str(aliases), *numbers)
    return table


if __name__ == "__main__":
    tyro.cli(main)
