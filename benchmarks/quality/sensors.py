"""Benchmarks of sensor effects: gravity of a walk by IMU and ground, deskewing of fast turns, and rotated scans."""

import dataclasses
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
import tyro
from jaxtyping import Float
from scipy.interpolate import CubicSpline
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation, RotationSpline

import sglpr_jax
from benchmarks.drives import WALKS, Drives, in_memory, lidar, recording_of
from benchmarks.table import Table
from sglpr_jax.data.deskew import deskew as deskew_points
from sglpr_jax.data.gravity import IMU_TILT_DEG, mounted
from sglpr_jax.data.imu import STANDARD_GRAVITY, Imu
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scan import Scan
from sglpr_jax.data.views import view
from sglpr_jax.models.shipped import DEFAULT_WEIGHTS
from sglpr_jax.models.weights import Params
from sglpr_jax.se3 import inverse, transformed
from sglpr_jax.sim.drive import TimedPoses, plan_path, poses_on
from sglpr_jax.sim.recording import SimulatedRecording
from sglpr_jax.sim.sensor import Sensor, scan
from sglpr_jax.sim.world import World, build_world

WALK = 0.2
"""Speed of a walking person, as a fraction of the speed of the simulated drive."""
RATE_HZ = 200.0
GYRO_NOISE, GYRO_BIAS = 0.003, 0.005
"""Standard deviations of a sample and of the bias of the gyroscope, in radians per second."""
ACCELERATION_NOISE, ACCELERATION_BIAS = 0.05, 0.03
"""Standard deviations of a sample and of the bias of the accelerometer, in m/s^2."""
TURN_S, SECTORS = 0.1, 36
SWING_S = 2.0
"""Period of the yaw rate. Its maximum is in the middle of the scan, and it is 0 after half a second."""
MOTIONS = {"car": (10.0, 25.0), "robot": (1.0, 90.0), "hand": (1.4, 180.0)}
"""Speed in m/s and maximum yaw rate in degrees per second."""
AZIMUTHS = 900
OTHER_PLACE_M = 20.0
CARRIED = dataclasses.replace(WALKS, sensor=("vlp16",))
BATCH = 64


def imu(
    drives: tyro.conf.OmitArgPrefixes[Drives] = CARRIED,
    *,
    blind: float = 0.0,
) -> None:
    """Compare roll and pitch of a sensor in a hand by its IMU and by the ground of its scans.

    The motion is a smooth curve through the poses of a simulated drive, at a fifth of its horizontal size, because
    people walk. The IMU has 200 Hz, noise and biases. Prints the error of roll and pitch against gravity, and the share
    of errors within 2 standard deviations. The constants of the library were fitted on seeds 500 and 503.

    Args:
        drives: drives to measure.
        blind: share of the scans that do not see the ground.
    """
    table = Table("drive", "gravity", "roll, pitch [deg]", "95 %", "within 2 sigma")
    for drive in drives:
        recording = drives.simulate(drive)
        measured = _measured_imu(recording.poses, np.random.default_rng(drive.seed))
        ups = measured.ups(recording.poses.times)[0]
        cells = _gravity_errors(ups, np.full(len(ups), IMU_TILT_DEG), recording.poses)
        table.add(drive.name, "IMU alone", *cells)
        rendered = dataclasses.replace(_without_ground(recording, blind), mounting=None)
        for how, read in (("ground", None), ("IMU and ground", lambda ups=ups: (ups, "an IMU"))):
            opened = mounted(dataclasses.replace(rendered, read_ups=read), "auto", gravity="scan", known=False)
            mountings = opened.mountings or ()
            estimated = np.array([one.up for one in mountings])
            sigmas_deg = np.array([one.tilt_deviation_deg for one in mountings], float)
            table.add(drive.name, how, *_gravity_errors(estimated, sigmas_deg, recording.poses))


def _without_ground(recording: SimulatedRecording, share: float) -> Recording:
    """Recording in memory. A random fraction `share` of its scans has no points below the sensor."""
    rendered = in_memory(recording)
    paths_without_ground = {path for path in rendered.paths if np.random.default_rng(int(path.name)).random() < share}
    rotations = dict(zip(rendered.paths, recording.poses.world_from_lidar[:, :3, :3], strict=True))

    def read(path: Path, labels: Path | None) -> Scan:
        points = rendered.read(path, None).points
        assert points is not None
        if path in paths_without_ground:
            points = points[points @ rotations[path][2] > 0]  # height above the sensor
        return Scan(points=points)

    return dataclasses.replace(rendered, read=read)


def _gravity_errors(
    ups: Float[np.ndarray, "n 3"], sigma_deg: Float[np.ndarray, " n"], poses: TimedPoses
) -> tuple[str, str, str]:
    """Cells: median and 95 % quantile of the errors about the two horizontal axes, and the share within 2 sigma.

    `ups` are estimated upward unit vectors in the LiDAR frame.
    """
    ups_in_world = np.einsum("nij,nj->ni", poses.world_from_lidar[:, :3, :3], ups)
    errors_deg = np.abs(np.degrees(ups_in_world[:, :2]))  # for small errors, the sine is the angle
    within_2_sigma = (errors_deg <= 2 * sigma_deg[:, None]).mean()
    return f"{np.median(errors_deg):.2f}", f"{np.quantile(errors_deg, 0.95):.2f}", f"{within_2_sigma:.3f}"


def _measured_imu(poses: TimedPoses, rng: np.random.Generator) -> Imu:
    """Samples of an IMU in the frame of the LiDAR, along a smooth curve through the poses."""
    times = np.arange(poses.times[0], poses.times[-1], 1 / RATE_HZ)
    rotation = RotationSpline(poses.times, Rotation.from_matrix(poses.world_from_lidar[:, :3, :3]))
    position = CubicSpline(poses.times, poses.world_from_lidar[:, :3, 3] * [WALK, WALK, 1.0])
    accelerations = rotation(times).inv().apply(position(times, 2) + np.array([0, 0, STANDARD_GRAVITY]))
    angular_rates = rotation(times, 1)

    def with_noise(samples: np.ndarray, noise: float, bias: float) -> np.ndarray:
        return samples + rng.normal(scale=bias, size=3) + rng.normal(scale=noise, size=samples.shape)

    noisy_rates = with_noise(angular_rates, GYRO_NOISE, GYRO_BIAS)
    return Imu(times, noisy_rates, with_noise(accelerations, ACCELERATION_NOISE, ACCELERATION_BIAS))


class _ScanStart(NamedTuple):
    """Position in a town and time at which a scan begins."""

    world: World
    xy: Float[np.ndarray, "2"]
    yaw: float
    clock: float
    sensor: Sensor

    def poses(self, times: Float[np.ndarray, " n"], speed_mps: float, turn_deg: float) -> Float[np.ndarray, "n 4 4"]:
        """Poses of the LiDAR at `times` (seconds since the start of the scan). `turn_deg` is the maximum yaw rate."""
        even_times = np.linspace(-2 * TURN_S, 2 * TURN_S, 401)
        omega = 2 * np.pi / SWING_S
        yaw = self.yaw + np.radians(turn_deg) / omega * np.sin(omega * (even_times - TURN_S / 2))
        forward = np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
        xy = np.cumsum(forward, axis=0) * speed_mps * (even_times[1] - even_times[0])
        xy += self.xy - xy[len(even_times) // 2]  # at `self.xy` when the scan starts
        x, y, yaw = (np.interp(times, even_times, coordinate) for coordinate in (*xy.T, yaw))
        return poses_on(self.world.ground.relief, np.stack([x, y], axis=1), yaw, height_m=self.sensor.height_m)

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
        return sectors, np.repeat(_sector_times(), [len(points) for points in sectors]).astype(np.float32)


def _sector_times() -> Float[np.ndarray, " sectors"]:
    """Time of the middle of each sector in seconds since the start of the scan."""
    return (np.arange(SECTORS) + 0.5) * TURN_S / SECTORS


def deskew(
    *,
    sensors: tuple[str, ...] = ("vlp16",),
    seeds: tuple[int, ...] = (611, 612),
    places: int = 12,
    weights: str = "sglpr",
) -> None:
    """Measure points and descriptors of scans on a fast turn, before and after deskewing.

    A scan of 0.1 s is put together from sectors, each rendered at the pose of its time. Points are deskewed with the
    true poses of this scan and of its neighbours. The descriptors are compared with that of a scan rendered at the pose
    of the scan, with other noise. Beside them is the distance of two such scans, and of the nearest other place.

    Args:
        sensors: names of sensors.
        seeds: one town for each.
        places: scans of each town.
        weights: the model that describes the scans.
    """
    columns = ("points skewed", "deskewed [m]", "descriptors skewed", "deskewed", "no motion", "elsewhere")
    params, table = sglpr_jax.load(weights), Table("sensor", "motion", *columns)
    for name in sensors:
        towns = [_town(seed, places, lidar(name, AZIMUTHS)) for seed in seeds]
        for motion, (speed_mps, turn_deg) in MOTIONS.items():
            cells = _motion_errors(speed_mps, turn_deg, towns, params)
            table.add(name, f"{motion}, {speed_mps:g} m/s, {turn_deg:g} deg/s", *cells)


def _town(seed: int, places: int, sensor: Sensor) -> list[_ScanStart]:
    """Places along a route of a town."""
    path = plan_path(np.random.default_rng((seed, 1)), "00", scans=600)
    world = build_world((seed, 2), path.xy, path.times)
    rows = np.linspace(20, len(path.times) - 20, places).astype(int)
    return [_ScanStart(world, path.xy[i], float(path.yaw[i]), float(path.times[i]), sensor) for i in rows]


def _motion_errors(speed_mps: float, turn_deg: float, towns: list[list[_ScanStart]], params: Params) -> list[str]:
    """Cells: median and 95 % quantile of the errors of points, and median distances of descriptors."""
    point_errors: dict[str, list[np.ndarray]] = {"skewed": [], "deskewed": []}
    descriptor_distances: dict[str, list[np.ndarray]] = {"skewed": [], "deskewed": [], "again": [], "other": []}
    for starts in towns:
        clouds: dict[str, list[np.ndarray]] = {"still": [], "again": [], "skewed": [], "deskewed": []}
        for number, start in enumerate(starts):
            scan_times = TURN_S * np.array([-1.0, 0.0, 1.0])  # of this scan and its neighbours
            scan_poses = start.poses(scan_times, speed_mps, turn_deg)
            sector_poses = start.poses(_sector_times(), speed_mps, turn_deg)
            sectors, times = start.moving_scan(sector_poses, 3 * number)
            true_points = [
                transformed(inverse(scan_poses[1]) @ pose, points)
                for pose, points in zip(sector_poses, sectors, strict=True)
            ]
            skewed = np.concatenate(sectors)
            deskewed = deskew_points(skewed, times, time=0.0, pose_times=scan_times, world_from_lidar=scan_poses)
            for name, cloud in (("skewed", skewed), ("deskewed", deskewed)):
                clouds[name].append(cloud)
                point_errors[name].append(np.linalg.norm(cloud - np.concatenate(true_points), axis=1))
            clouds["still"].append(start.scan(scan_poses[1], 3 * number + 1))
            clouds["again"].append(start.scan(scan_poses[1], 3 * number + 2))  # with other noise
        descriptors = {name: _descriptors(params, scans) for name, scans in clouds.items()}
        for name in ("skewed", "deskewed", "again"):
            descriptor_distances[name].append(np.linalg.norm(descriptors[name] - descriptors["still"], axis=1))
        xy = np.array([start.xy for start in starts])
        distance = cdist(descriptors["still"], descriptors["still"])
        distance[cdist(xy, xy) < OTHER_PLACE_M] = np.inf
        descriptor_distances["other"].append(distance.min(axis=1))
    metres = [np.concatenate(errors) for errors in point_errors.values()]
    cells = [f"{np.median(errors):.3f}, 95 % {np.quantile(errors, 0.95):.3f}" for errors in metres]
    return cells + [f"{np.median(np.concatenate(of_scans)):.3f}" for of_scans in descriptor_distances.values()]


def _descriptors(params: Params, clouds: list[np.ndarray]) -> Float[np.ndarray, "n d"]:
    scans = [Scan(points=np.ascontiguousarray(cloud, np.float32)) for cloud in clouds]
    return sglpr_jax.embed(params, recording_of("scans", scans)).descriptors


def rotation(
    *,
    data: Path,
    seq: str | None = None,
    weights: tuple[str, ...] = (DEFAULT_WEIGHTS,),
    scans: int = 20,
    step_deg: int = 1,
    among: int = 1000,
) -> None:
    """Measure how far descriptors move when a scan rotates, as a share of the distance to the nearest other place.

    Args:
        data: a dataset with poses.
        seq: which recording of it.
        weights: names of shipped weights, or folders.
        scans: scans that are rotated, evenly spaced over the recording.
        step_deg: degrees between two rotations.
        among: scans, evenly spaced, among which the nearest other place is searched, more than 20 m away.
    """
    recording = sglpr_jax.open_recording(data, seq)
    rows, others = (np.unique(np.linspace(0, len(recording) - 1, n).astype(int)) for n in (scans, among))
    angles = np.radians(np.arange(step_deg, 360, step_deg))
    for name in weights:
        params = sglpr_jax.load(name)
        unrotated = _rotated(params, recording, [(row, None) for row in rows])
        elsewhere = cdist(unrotated, _rotated(params, recording, [(row, None) for row in others]))
        apart = cdist(recording.positions[rows, :2], recording.positions[others, :2])
        nearest = np.where(apart > OTHER_PLACE_M, elsewhere, np.inf).min(axis=1)
        turned = _rotated(params, recording, [(row, angle) for row in rows for angle in angles])
        moved = np.linalg.norm(turned.reshape(len(rows), len(angles), -1) - unrotated[:, None], axis=2)
        share = moved / nearest[:, None]
        print(
            f"{name}: {moved.size} rotations of {len(moved)} scans: moved by {np.median(moved):.3f} (median), "
            f"{np.quantile(moved, 0.95):.3f} (95 %), {moved.max():.3f} (most); the nearest other place at "
            f"{np.median(nearest):.3f} (median), {nearest.min():.3f} (least); share {np.median(share):.3f} (median), "
            f"{np.quantile(share, 0.95):.3f} (95 %)"
        )


def _rotated(params: Params, recording: Recording, views: list) -> Float[np.ndarray, "n d"]:
    """Descriptors of scans that are rotated. `views` are pairs of row and angle (radians, or None)."""
    describe, config, descriptors = jax.jit(sglpr_jax.describe), params.config, []
    for start in range(0, len(views), BATCH):
        batch = views[start : start + BATCH]
        rotated = [view(recording.scan(row), config.grid, image=config.image, angle=angle) for row, angle in batch]
        images = [np.asarray(of_scan.image) for of_scan in rotated]
        images += images[-1:] * (BATCH - len(images))  # padding, so that all batches use the same compiled program
        descriptors.append(np.asarray(describe(params, np.stack(images)))[: len(batch)])
    return np.concatenate(descriptors)
