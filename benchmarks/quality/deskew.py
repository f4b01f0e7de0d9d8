"""What deskewing gives on a fast turn: error of points, and distance of descriptors to those of scans without motion.

    python -m benchmarks.quality.deskew --sensors vlp16 os1-64 --seeds 611 612

A scan of .1 s is put together from sectors, each rendered at the pose of its time. The yaw rate changes within it.
Points are deskewed with the true poses of this scan and of its neighbours, .1 s before and after. The descriptors are
compared with that of a scan rendered at the pose of the scan, with other noise. Beside them is the distance of two such
scans, and the distance of the nearest other place.
"""

import dataclasses
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
import tyro
from jaxtyping import Float

import sglpr_jax
from sglpr_jax.data.deskew import deskew
from sglpr_jax.data.recording import Record, Recording
from sglpr_jax.se3 import distances, inverse, transformed
from sglpr_jax.sim.drive import plan_path, poses_on
from sglpr_jax.sim.sensor import SENSORS, Sensor, scan
from sglpr_jax.sim.world import World, build_world

TURN_S, SECTORS = 0.1, 36
SWING_S = 2.0
"""Period of the yaw rate. Its maximum is in the middle of the scan, and it is 0 after half a second."""
MOTIONS = {"car": (10.0, 25.0), "robot": (1.0, 90.0), "hand": (1.4, 180.0)}
"""Speed in m/s and maximum yaw rate in degrees per second."""
AZIMUTHS = 900
ELSEWHERE_M = 20.0


class Place(NamedTuple):
    """A place of a town and the time when a scan begins there."""

    world: World
    xy: Float[np.ndarray, "2"]
    yaw: float
    clock: float
    sensor: Sensor

    def poses(self, times: Float[np.ndarray, " n"], speed_mps: float, turn_deg: float) -> Float[np.ndarray, "n 4 4"]:
        """Poses of the LiDAR at times since the begin of the scan."""
        steps = np.linspace(-2 * TURN_S, 2 * TURN_S, 401)
        angle = 2 * np.pi / SWING_S
        yaw = self.yaw + np.radians(turn_deg) / angle * np.sin(angle * (steps - TURN_S / 2))
        forward = np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
        xy = np.cumsum(forward, axis=0) * speed_mps * (steps[1] - steps[0])
        xy += self.xy - xy[len(steps) // 2]
        x, y, yaw = (np.interp(times, steps, values) for values in (*xy.T, yaw))
        at = np.stack([x, y], axis=1)
        return poses_on(self.world.ground.relief, at, yaw, height_m=self.sensor.height_m)

    def scan(self, pose: Float[np.ndarray, "4 4"], seed: int) -> Float[np.ndarray, "n 3"]:
        """A scan without motion."""
        return scan(jax.random.key(seed), self.world, pose, sensor=self.sensor, time=self.clock)[0][:, :3]

    def moving_scan(self, poses: Float[np.ndarray, "sectors 4 4"], seed: int) -> tuple[list[np.ndarray], np.ndarray]:
        """The points of each sector in the frame of its pose, and the times of all points."""
        sectors = []
        for number, pose in enumerate(poses):
            points = self.scan(pose, seed)
            azimuth = np.arctan2(points[:, 1], points[:, 0]) % (2 * np.pi)
            sectors.append(points[np.floor(azimuth / (2 * np.pi) * SECTORS).astype(int) == number])
        return sectors, np.repeat(middles(), [len(points) for points in sectors]).astype(np.float32)


def middles() -> Float[np.ndarray, " sectors"]:
    """Time of each sector since the begin of the scan."""
    return (np.arange(SECTORS) + 0.5) * TURN_S / SECTORS


def main(
    *,
    sensors: tuple[str, ...] = ("vlp16",),
    seeds: tuple[int, ...] = (611, 612),
    places: int = 12,
    weights: str = "sglpr",
) -> None:
    """Print a row for each sensor and motion.

    Args:
        sensors: names of `sim.SENSORS`.
        seeds: one town for each.
        places: scans of each town.
        weights: the model that describes the scans.
    """
    print(
        "| sensor | motion | points skewed | deskewed [m] | descriptors skewed | deskewed | no motion | elsewhere |\n"
        "|---|---|---|---|---|---|---|---|"
    )
    params = sglpr_jax.load(weights)
    for name in sensors:
        lidar = SENSORS[name]
        lidar = dataclasses.replace(lidar, azimuth_steps=min(lidar.azimuth_steps, AZIMUTHS))
        towns = [town(seed, places, lidar) for seed in seeds]
        for motion in MOTIONS:
            print(row(name, motion, towns, params), flush=True)


def town(seed: int, places: int, sensor: Sensor) -> list[Place]:
    """Places along a route of a town."""
    path = plan_path(np.random.default_rng((seed, 1)), "00", scans=600)
    world = build_world((seed, 2), path.xy, path.times)
    rows = np.linspace(20, len(path.times) - 20, places).astype(int)
    return [Place(world, path.xy[i], float(path.yaw[i]), float(path.times[i]), sensor) for i in rows]


def row(name: str, motion: str, towns: list[list[Place]], params: sglpr_jax.Params) -> str:
    """One row of the table: medians, and 95 % quantiles of the points."""
    speed_mps, turn_deg = MOTIONS[motion]
    errors: dict[str, list[np.ndarray]] = {"skewed": [], "deskewed": []}
    apart: dict[str, list[np.ndarray]] = {"skewed": [], "deskewed": [], "again": [], "other": []}
    for places in towns:
        clouds: dict[str, list[np.ndarray]] = {"still": [], "again": [], "skewed": [], "deskewed": []}
        for number, place in enumerate(places):
            stamps = TURN_S * np.array([-1.0, 0.0, 1.0])
            trajectory, within = (place.poses(times, speed_mps, turn_deg) for times in (stamps, middles()))
            sectors, times = place.moving_scan(within, 3 * number)
            true = [
                transformed(inverse(trajectory[1]) @ pose, points) for pose, points in zip(within, sectors, strict=True)
            ]
            skewed = np.concatenate(sectors)
            found = deskew(skewed, times, time=0.0, pose_times=stamps, world_from_lidar=trajectory)
            for how, cloud in (("skewed", skewed), ("deskewed", found)):
                clouds[how].append(cloud)
                errors[how].append(np.linalg.norm(cloud - np.concatenate(true), axis=1))
            for how, seed in (("still", 3 * number + 1), ("again", 3 * number + 2)):
                clouds[how].append(place.scan(trajectory[1], seed))
        described = {how: sglpr_jax.embed(params, in_memory(found)).descriptors for how, found in clouds.items()}
        for how in ("skewed", "deskewed", "again"):
            apart[how].append(np.linalg.norm(described[how] - described["still"], axis=1))
        at = np.array([place.xy for place in places])
        others = distances(described["still"], described["still"])
        others[distances(at, at) < ELSEWHERE_M] = np.inf
        apart["other"].append(others.min(axis=1))
    metres = [np.concatenate(values) for values in errors.values()]
    cells = [f"{np.median(values):.3f}, 95 % {np.quantile(values, 0.95):.3f}" for values in metres]
    cells += [f"{np.median(np.concatenate(values)):.3f}" for values in apart.values()]
    return f"| {name} | {motion}, {speed_mps:g} m/s, {turn_deg:g} deg/s | {' | '.join(cells)} |"


def in_memory(clouds: list[np.ndarray]) -> Recording:
    """A recording of these scans."""
    paths = tuple(Path(f"{i:03d}") for i in range(len(clouds)))
    found = {path: np.ascontiguousarray(cloud, np.float32) for path, cloud in zip(paths, clouds, strict=True)}
    return Recording(
        name="scans",
        ids=tuple(map(str, paths)),
        positions=None,
        times=None,
        pose_source=None,
        paths=paths,
        read=lambda path, labels, lasers: Record(points=found[path]),
        on_disk=False,
    )


if __name__ == "__main__":
    tyro.cli(main)
