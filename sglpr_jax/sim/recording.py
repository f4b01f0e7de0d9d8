"""Simulated drive as a recording. Its scans are rendered on demand and not stored on disk."""

import dataclasses
import functools
from collections.abc import Callable
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
from sglpr_jax.sim import RATE_HZ
from sglpr_jax.sim.drive import (
    VEHICLE,
    Carrier,
    PlanarPath,
    TimedPoses,
    check_drawing,
    drive_seed,
    name_of_path,
    plan_path,
    poses_on,
    read_path,
    scan_rows,
    speeds,
)
from sglpr_jax.sim.sensor import HDL64E, Sensor, scan
from sglpr_jax.sim.styles import TOWN, Scenery
from sglpr_jax.sim.world import World, build_world

KEPT_SCANS = 8  # number of cached scans, so that reading points and labels of a scan renders it once


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
    scans: int = 300,
    sensor: Sensor = HDL64E,
    seed: int = 0,
    rate_hz: float = RATE_HZ,
    scenery: Scenery = TOWN,
    carrier: Carrier = VEHICLE,
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

    Raises:
      ValueError: The route is unknown, `rate_hz` is not positive, `seed` is negative, or the pose file is malformed.
      FileNotFoundError: The pose file does not exist.
    """
    check_drawing(rate_hz, seed)
    name = name if along is None else name_of_path(along)
    seeds = drive_seed(seed, name)
    if along is None:
        path = plan_path(np.random.default_rng((*seeds, 1)), name, scans=scans, rate_hz=rate_hz)
    else:
        path = read_path(along)
    world = build_world(seeds, path.xy, path.times, scenery=scenery)
    rows = scan_rows(path, scans)
    return drive_through(world, path, rows, name=name, sensor=sensor, carrier=carrier, **random_of(seeds))


def with_submaps(recording: SimulatedRecording, length_m: float) -> SimulatedRecording:
    """Returns the recording with submaps of `length_m` metres by the true poses, or unchanged with 0 metres."""
    if not length_m:
        return recording
    view = submaps(recording, recording.poses.world_from_lidar, length_m=length_m)

    def render(i: int) -> tuple[np.ndarray, np.ndarray]:
        scan = view.scan(i)
        assert scan.points is not None and scan.labels is not None
        return np.pad(scan.points, ((0, 0), (0, 1))), scan.labels  # submaps have no intensities

    return dataclasses.replace(recording, read=view.read, render=render, found=view.found)


def numbered(scans: int) -> tuple[str, ...]:
    """Names of scans that are numbered from 0."""
    return tuple(f"{i:06d}" for i in range(scans))


def random_of(seeds: tuple[int, ...]) -> dict[str, Any]:
    """`key` and `rng` of `drive_through`."""
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
) -> SimulatedRecording:
    """Returns the recording of a drive through a town.

    Arguments:
      world: Town.
      path: Path of the vehicle, with the times of the town.
      rows: Rows of `path` at which scans are taken.
      name: Name of the recording.
      ids: Names of the scans. None numbers them.
      times: Times of the scans in the recording, in seconds. None: the times of the town.
      sensor: LiDAR.
      key: Random key of the measurements.
      rng: Random generator of the sway of the carrier.
      carrier: Carrier of the sensor. Its height and sway are used.
    """
    clock = path.times[rows]
    ids, times = ids or numbered(len(rows)), clock if times is None else times
    tilt, height, left = carrier.motion(rng, clock, height_m=sensor.height_m)
    yaw = path.yaw[rows]
    aside = np.reshape(left, (-1, 1)) * np.stack([-np.sin(yaw), np.cos(yaw)], axis=1)
    of_lidar = in_world = poses_on(world.ground.relief, path.xy[rows] + aside, yaw, height_m=height, tilt=tilt)
    if world.levels is not None:  # storeys above one another
        there, ground, slope = (values[rows] for values in world.levels.along(path.xy))
        in_world = poses_on(world.ground.relief, there + aside, yaw, height_m=height, tilt=tilt)
        of_lidar = poses_on((ground, slope), path.xy[rows] + aside, yaw, height_m=height, tilt=tilt)
    speed = speeds(path)[rows]
    height_m = sensor.height_m if carrier.height_m is None else carrier.height_m
    row_of = {scan_id: i for i, scan_id in enumerate(ids)}

    @functools.lru_cache(maxsize=KEPT_SCANS)
    def render(i: int) -> tuple[np.ndarray, np.ndarray]:
        pose, velocity = in_world[i], np.array([speed[i], 0, 0])
        return scan(jax.random.fold_in(key, i), world, pose, sensor=sensor, time=float(clock[i]), velocity=velocity)

    def read(path: Path, label_path: Path | None, lasers: bool) -> Scan:
        points, labels = render(row_of[path.name])
        return Scan(points=points[:, :3], labels=None if label_path is None else labels)

    names = tuple(Path(scan_id) for scan_id in ids)
    return SimulatedRecording(
        name=name,
        ids=ids,
        positions=of_lidar[:, :3, 3],
        times=times,
        pose_source="simulation",
        paths=names,
        label_paths=names,
        read=read,
        mounting=None if height_m == MODEL_HEIGHT_M else Mounting(height_m),
        on_disk=False,
        poses=TimedPoses(of_lidar, times),
        render=render,
    )
