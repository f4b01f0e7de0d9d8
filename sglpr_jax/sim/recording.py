"""Simulated drives through towns and repeating sceneries, as recordings whose scans are rendered on demand."""

import dataclasses
import datetime
import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray

from sglpr_jax.data.mounting import MODEL_HEIGHT_M, Mounting
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scan import Scan
from sglpr_jax.data.submap import submaps
from sglpr_jax.sim import RATE_HZ, SCANS
from sglpr_jax.sim.drive import (
    VEHICLE,
    Carrier,
    PlanarPath,
    TimedPoses,
    check_rate_and_seed,
    drive_seed,
    name_of_path,
    plan_path,
    poses_on,
    read_path,
    scan_rows,
    timed,
)
from sglpr_jax.sim.layouts import to_utime
from sglpr_jax.sim.routes import REVISITS, Revisit
from sglpr_jax.sim.sceneries import REPEATING, Repeating
from sglpr_jax.sim.sceneries.site import LAPS, build, driven_line
from sglpr_jax.sim.sensor import HDL64E, SENSORS, Sensor, scan
from sglpr_jax.sim.styles import TOWN, Scenery
from sglpr_jax.sim.world import World, build_world

KEPT_SCANS = 8  # number of cached scans, so that reading points and labels of a scan renders it once
SHORTEST_REPEATING_S = (
    75.0  # minimum duration of a drive where places repeat, in seconds, over which few scans are spread
)
CLOSE_RANGE_M = 0.5  # maximum of a sensor's minimum range at the height of a carrier or scenery, in metres
PAUSE_S = 1800.0  # pause between two days, in seconds: three times the mean stay of a parked car
START_H = 12  # hour (UTC) at which each session starts


@dataclass(frozen=True, eq=False)
class SimulatedRecording(Recording):
    """Recording whose labelled scans are rendered on demand. `paths` and `label_paths` do not name files."""

    poses: TimedPoses = field(kw_only=True)  # pose of the LiDAR and time of each scan
    render: Callable[[int], tuple[np.ndarray, np.ndarray]] = field(kw_only=True)
    """Function that returns points (n, 4) with intensities and labels (n,) of scan i.

    Every call gives the same values. The arrays are cached and must not be modified in place.
    """


class PlannedRecording(NamedTuple):
    """Recording before it is simulated."""

    name: str
    ids: tuple[str, ...]
    simulate: Callable[[], SimulatedRecording]


def simulate_recording(
    name: str = "00",
    *,
    along: Path | None = None,
    scans: int = SCANS,
    sensor: Sensor = HDL64E,
    seed: int = 0,
    rate_hz: float = RATE_HZ,
    scenery: Scenery = TOWN,
    carrier: Carrier = VEHICLE,
    aside_m: float = 0.0,
) -> SimulatedRecording:
    """Builds the town around a drive and returns the recording. `simulate` writes the same scans for equal arguments.

    Arguments:
      name: Route, from `ROLES`.
      along: KITTI pose file to drive along instead of a route, see `read_path`.
      scans: Number of scans. Along a pose file it is the maximum: of a longer file, every k-th line is used.
      sensor: LiDAR.
      seed: Seed of the town, at least 0.
      rate_hz: Scans per second of a route. Not used along a pose file.
      scenery: Scenery of the town.
      carrier: Carrier of the sensor. Only its height and sway are used: speed and rate are those of the route, and the
        carrier does not halt.
      aside_m: Distance to the left of the drive around which the town was built, in metres, as on another lane.

    Raises:
      ValueError: The route is unknown, `rate_hz` is not positive, `seed` is negative, or the pose file is malformed.
      FileNotFoundError: The pose file does not exist.
    """
    check_rate_and_seed(rate_hz, seed)
    name = name if along is None else name_of_path(along)
    seeds = drive_seed(seed, name)
    if along is None:
        path = plan_path(np.random.default_rng((*seeds, 1)), name, scans=scans, rate_hz=rate_hz)
    else:
        path = read_path(along)
    world = build_world(seeds, path.xy, path.times, scenery=scenery)
    rows = scan_rows(path, scans)
    options = {"name": name, "sensor": sensor, "carrier": carrier, "aside_m": aside_m}
    return drive_through(world, path, rows, **options, **_key_and_rng(seeds))


def simulate_repeating(
    name: str,
    *,
    scans: int = SCANS,
    seed: int = 0,
    sensor: Sensor = HDL64E,
    revisit: Revisit = "none",
    rate_hz: float | None = None,
    carrier: Carrier = VEHICLE,
    aside_m: float = 0.0,
) -> SimulatedRecording:
    """Returns the recording of a drive through a scenery where different places look alike.

    Arguments:
      name: Scenery, from `REPEATING`.
      scans: Number of scans, evenly spaced over the drive.
      seed: Seed of the scenery and the drive, at least 0.
      sensor: LiDAR. A height of the carrier or the scenery replaces its own, with a minimum range of at most 0.5 m.
      revisit: "none": frames 30 s apart are farther apart than the scenery's `other_m`. "opposite": returns along the
        same path. "same": drives one and a half laps along a closed path.
      rate_hz: Scans per second. None uses the rate of the carrier or of the scenery.
      carrier: Carrier of the sensor, such as one of `CARRIERS`. Slow ones and halts bring frames 30 s apart closer.
      aside_m: Distance to the left of the usual line, in metres.

    Raises:
      ValueError: The name or `revisit` is unknown, `rate_hz` is not positive, or `seed` is negative.

    Example:
      drive = simulate_repeating("yard", seed=1, revisit="same", carrier=CARRIERS["backpack"])
    """
    if name not in REPEATING:
        raise ValueError(f"expected a scenery among {', '.join(REPEATING)}, found {name!r}")
    if revisit not in REVISITS:
        raise ValueError(f"revisit: expected one of {', '.join(REVISITS)}, found {revisit!r}")
    scenery = REPEATING[name]
    rate_hz = carrier.rate_hz or scenery.rate_hz if rate_hz is None else rate_hz
    check_rate_and_seed(rate_hz, seed)
    seeds = drive_seed(seed, f"{name} {revisit}")
    world, path = plan_drive(scenery, seeds, scans=scans, revisit=revisit, rate_hz=rate_hz, carrier=carrier)
    height_m = carried_height_m(carrier, scenery)
    if height_m is not None:
        sensor = dataclasses.replace(sensor, height_m=height_m, min_range_m=min(CLOSE_RANGE_M, sensor.min_range_m))
    options = {"name": f"{name}-{revisit}", "sensor": sensor, "carrier": carrier, "aside_m": aside_m}
    return drive_through(world, path, scan_rows(path, scans), **options, **_key_and_rng(seeds))


def carried_height_m(carrier: Carrier, scenery: Repeating | None = None) -> float | None:
    """Height of the sensor above the ground that the carrier or else the scenery gives, or None: that of the sensor."""
    if carrier.height_m is None and scenery is not None:
        return scenery.height_m
    return carrier.height_m


def plan_drive(
    scenery: Repeating,
    seeds: tuple[int, ...],
    *,
    scans: int,
    revisit: Revisit,
    rate_hz: float,
    carrier: Carrier = VEHICLE,
) -> tuple[World, PlanarPath]:
    """Draws a scenery and the drive through it. The number of poses is a multiple of `scans`."""
    rng = np.random.default_rng((*seeds, 1))
    speed = rng.uniform(*(carrier.speed_mps or scenery.speed_mps))
    passes = {"none": 1, "opposite": 2, "same": LAPS}[revisit]
    length_m = max(scans / rate_hz, SHORTEST_REPEATING_S) * speed / passes
    if revisit == "same":  # a lap has room for the scenery even if the carrier is slow
        length_m = max(length_m, SHORTEST_REPEATING_S * scenery.speed_mps[0] / LAPS)
    site = scenery.site(rng, length_m, scenery.is_closed(revisit))
    line = driven_line(rng, site, revisit, right_m=scenery.right_m, sway_m=scenery.sway_m)
    path = carrier.halted(rng, timed(rng, line, free_mps=speed, poses=scans), poses=scans)
    return build(site, line, clearance_m=scenery.clearance_m), path


def plan_sessions(
    dates: Sequence[str],
    *,
    route: str = "00",
    scans: int = SCANS,
    sensor: Sensor = SENSORS["hdl32e-nclt"],
    seed: int = 0,
    rate_hz: float = RATE_HZ,
    scenery: Scenery = TOWN,
) -> tuple[PlannedRecording, ...]:
    """Plans one session for each date. The town is built when the first session is simulated.

    The first session drives `route`, the others the same streets in another order, partly in the opposite direction. As
    in NCLT, times are seconds since 1970, and ids are these times in microseconds. Other arguments are as in
    `simulate_recording`.

    Raises:
      ValueError: A date is invalid or repeated, there are no dates, or `scans` is below 2. Or the route, `rate_hz` or
        `seed` is invalid.
    """
    check_rate_and_seed(rate_hz, seed)
    starts = [_start_of(date) for date in dates]
    if len(set(dates)) < max(len(dates), 1) or scans < 2:
        raise ValueError(f"expected different dates and 2 scans or more, found {', '.join(dates) or 'none'}; {scans}")
    seeds, days = drive_seed(seed, f"sessions {route}"), len(dates)
    path = plan_path(np.random.default_rng((*seeds, 1)), route, scans=scans, rate_hz=rate_hz, days=days)
    day_of_pose = np.arange(len(path.times)) * days // len(path.times)
    path = path._replace(times=path.times + PAUSE_S * day_of_pose)
    cached_town = functools.cache(lambda: build_world(seeds, path.xy, path.times, scenery=scenery))

    def plan(day: int, rows: np.ndarray) -> PlannedRecording:
        times = starts[day] + path.times[rows] - path.times[rows[0]]
        ids = tuple(str(to_utime(time)) for time in times.tolist())

        def simulate() -> SimulatedRecording:
            options = {"name": dates[day], "ids": ids, "times": times, "sensor": sensor}
            return drive_through(cached_town(), path, rows, **options, **_key_and_rng((*seeds, day)))

        return PlannedRecording(dates[day], ids, simulate)

    rows = np.arange(0, len(path.times), len(path.times) // (scans * days))
    return tuple(plan(day, rows_of_day) for day, rows_of_day in enumerate(np.split(rows, days)))


def _start_of(date: str) -> float:
    """Start of a session, in seconds since 1970. Raises ValueError if the date is invalid."""
    try:
        day = datetime.datetime.strptime(date, "%Y-%m-%d")
    except ValueError as error:
        raise ValueError(f"expected dates such as 2012-01-15, found {date!r}") from error
    return day.replace(hour=START_H, tzinfo=datetime.UTC).timestamp()


def with_submaps(recording: SimulatedRecording, length_m: float) -> SimulatedRecording:
    """Returns the recording with submaps of `length_m` metres instead of scans, joined with the true poses."""
    submap_recording = submaps(recording, recording.poses.world_from_lidar, length_m=length_m)

    def render(i: int) -> tuple[np.ndarray, np.ndarray]:
        submap = submap_recording.scan(i)
        assert submap.points is not None and submap.labels is not None
        return np.pad(submap.points, ((0, 0), (0, 1))), submap.labels  # intensities are 0

    return dataclasses.replace(recording, read=submap_recording.read, render=render, found=submap_recording.found)


def numbered_ids(scans: int) -> tuple[str, ...]:
    """Ids of scans that are numbered from 0: "000000", "000001" and so on."""
    return tuple(f"{i:06d}" for i in range(scans))


def _key_and_rng(seeds: tuple[int, ...]) -> dict[str, Any]:
    """Arguments `key` and `rng` of `drive_through`."""
    key = functools.reduce(jax.random.fold_in, seeds[1:], jax.random.key(seeds[0]))
    return {"key": key, "rng": np.random.default_rng((*seeds, 2))}


def drive_through(
    world: World,
    path: PlanarPath,
    rows: Int[np.ndarray, " n"],
    *,
    name: str,
    ids: tuple[str, ...] | None = None,
    times: Float[np.ndarray, " n"] | None = None,
    sensor: Sensor,
    key: PRNGKeyArray,
    rng: np.random.Generator,
    carrier: Carrier = VEHICLE,
    aside_m: float = 0.0,
) -> SimulatedRecording:
    """Returns the recording of a drive through a world along `path`, with scans at the poses in `rows`.

    By default, `ids` numbers the scans, and `times` (seconds) are those of the path. `key` draws the measurements, and
    `rng` the sway. The carrier determines height and sway, not the speed. The drive is `aside_m` to the left of `path`.
    """
    path_times, yaw = path.times[rows], path.yaw[rows]
    ids, times = ids or numbered_ids(len(rows)), path_times if times is None else times
    height_m = sensor.height_m if carrier.height_m is None else carrier.height_m
    tilt, height, left_m = carrier.motion(rng, path_times, height_m=height_m)
    sway = np.reshape(left_m + aside_m, (-1, 1)) * np.stack([-np.sin(yaw), np.cos(yaw)], axis=1)
    true_poses = poses_on(world.ground.relief, path.xy[rows] + sway, yaw, height_m=height, tilt=tilt)
    rendered_poses = true_poses
    if world.levels is not None:  # storeys above one another are simulated side by side
        xy, ground_height, slope = (per_pose[rows] for per_pose in world.levels.along(path.xy))
        rendered_poses = poses_on(world.ground.relief, xy + sway, yaw, height_m=height, tilt=tilt)
        true_poses = poses_on((ground_height, slope), path.xy[rows] + sway, yaw, height_m=height, tilt=tilt)
    row_of_id = {scan_id: i for i, scan_id in enumerate(ids)}

    @functools.lru_cache(maxsize=KEPT_SCANS)
    def render(i: int) -> tuple[np.ndarray, np.ndarray]:
        return scan(jax.random.fold_in(key, i), world, rendered_poses[i], sensor=sensor, time=float(path_times[i]))

    def read(path: Path, label_path: Path | None) -> Scan:
        points, labels = render(row_of_id[path.name])
        return Scan(points=points[:, :3], labels=None if label_path is None else labels)

    paths = tuple(Path(scan_id) for scan_id in ids)  # not files: `read` finds the id in them
    return SimulatedRecording(
        name=name,
        ids=ids,
        positions=true_poses[:, :3, 3],
        times=times,
        pose_source="simulation",
        paths=paths,
        label_paths=paths,
        read=read,
        mounting=None if height_m == MODEL_HEIGHT_M else Mounting(height_m),
        on_disk=False,
        poses=TimedPoses(true_poses, times),
        render=render,
    )
