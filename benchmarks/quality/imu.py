"""Compare roll and pitch of a sensor in a hand by its IMU and by the ground of its scans.

    python -m benchmarks.quality.imu --drives town:08:620 outskirts:06:622 --sensor vlp16

The motion is a smooth curve through the poses of a simulated drive, at a fifth of its horizontal size, because people
walk. The IMU measures accelerations and angular velocities at 200 Hz, with noise and with biases. The program prints
the error of roll and pitch against gravity, and the share of these errors within 2 standard deviations. The ground has
slopes. With `--blind .5`, half of the scans do not see the ground. The constants were fitted on seeds 500 and 503.
"""

import dataclasses
from pathlib import Path

import numpy as np
import tyro
from jaxtyping import Float
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from benchmarks.quality.attitude import in_memory
from benchmarks.quality.covariance import STEPS
from sglpr_jax.data.gravity import IMU_TILT_DEG, mounted
from sglpr_jax.data.imu import STANDARD_GRAVITY, Imu
from sglpr_jax.data.mounting import Mounting
from sglpr_jax.data.recording import Record, Recording
from sglpr_jax.sim.drive import TimedPoses
from sglpr_jax.sim.recording import SimulatedRecording, simulate_recording
from sglpr_jax.sim.scenery import SCENERIES
from sglpr_jax.sim.sensor import SENSORS

WALK = 0.2
"""Speed of a person as a share of that of the simulated drive."""
RATE_HZ = 200.0
GYRO_NOISE, GYRO_BIAS = 0.003, 0.005
"""Standard deviations of a sample and of the bias of the gyroscope, in radians per second."""
ACCELERATION_NOISE, ACCELERATION_BIAS = 0.05, 0.03
"""Standard deviations of a sample and of the bias of the accelerometer, in m/s^2."""


def main(
    *,
    drives: tuple[str, ...] = ("town:08:620", "town:00:621", "outskirts:06:622", "gardens:08:623"),
    sensor: str = "vlp16",
    scans: int = 360,
    blind: float = 0.0,
) -> None:
    """Print a row for each drive and source of gravity.

    Args:
        drives: SCENERY:ROUTE:SEED.
        sensor: name of `sim.SENSORS`.
        scans: scans of a drive.
        blind: share of the scans that do not see the ground.
    """
    print("| drive | gravity | roll, pitch [deg] | 95 % | within 2 sigma |\n|---|---|---|---|---|")
    for name in drives:
        scenery, route, seed = name.split(":")
        lidar = dataclasses.replace(SENSORS[sensor], azimuth_steps=STEPS[sensor])
        options = {"sensor": lidar, "scenery": SCENERIES[scenery], "handheld": True}
        recording = simulate_recording(route, scans=scans, seed=int(seed), **options)
        imu = measured_imu(recording.poses, np.random.default_rng(int(seed)))
        ups = imu.ups(recording.poses.times)[0]
        print(row(name, "IMU alone", ups, np.full(len(ups), IMU_TILT_DEG), recording.poses), flush=True)
        rendered = dataclasses.replace(without_ground(recording, blind), mounting=None)
        for how, read in (("ground", None), ("IMU and ground", lambda ups=ups: (ups, "an IMU"))):
            opened = mounted(dataclasses.replace(rendered, read_ups=read), "auto", gravity="scan", known=False)
            print(row(name, how, *gravity_of(opened), recording.poses), flush=True)


def without_ground(recording: SimulatedRecording, share: float) -> Recording:
    """The recording in memory. A share of its scans has no points below the sensor."""
    rendered = in_memory(recording)
    hidden = {path for path in rendered.paths if np.random.default_rng(int(path.name)).random() < share}
    turned = dict(zip(rendered.paths, recording.poses.world_from_lidar[:, :3, :3], strict=True))

    def read(path: Path, labels: Path | None, lasers: bool) -> Record:
        points = rendered.read(path, None, False).points
        assert points is not None
        return Record(points=points if path not in hidden else points[points @ turned[path][2] > 0])

    return dataclasses.replace(rendered, read=read)


def gravity_of(recording: Recording) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
    """Up of each scan, and its standard deviation in degrees."""
    mountings: tuple[Mounting, ...] = recording.mountings or ()
    return np.array([one.up for one in mountings]), np.array([one.tilt_deviation_deg for one in mountings], float)


def row(
    name: str, how: str, ups: Float[np.ndarray, "n 3"], sigma_deg: Float[np.ndarray, " n"], poses: TimedPoses
) -> str:
    """One row of the table. The errors are those about the two horizontal axes."""
    in_world = np.einsum("nij,nj->ni", poses.world_from_lidar[:, :3, :3], ups)
    errors = np.degrees(in_world[:, :2])
    sizes = np.abs(errors)
    within = (sizes <= 2 * sigma_deg[:, None]).mean()
    return f"| {name} | {how} | {np.median(sizes):.2f} | {np.quantile(sizes, 0.95):.2f} | {within:.3f} |"


def measured_imu(poses: TimedPoses, rng: np.random.Generator) -> Imu:
    """Samples of an IMU in the frame of the LiDAR, along a smooth curve through the poses."""
    stamps = np.arange(poses.times[0], poses.times[-1], 1 / RATE_HZ)
    turned = RotationSpline(poses.times, Rotation.from_matrix(poses.world_from_lidar[:, :3, :3]))
    path = CubicSpline(poses.times, poses.world_from_lidar[:, :3, 3] * [WALK, WALK, 1.0])
    accelerations = turned(stamps).inv().apply(path(stamps, 2) + np.array([0, 0, STANDARD_GRAVITY]))
    noisy = []
    for values, noise, bias in (
        (turned(stamps, 1), GYRO_NOISE, GYRO_BIAS),
        (accelerations, ACCELERATION_NOISE, ACCELERATION_BIAS),
    ):
        noisy.append(values + rng.normal(scale=bias, size=3) + rng.normal(scale=noise, size=values.shape))
    return Imu(stamps, *noisy)


if __name__ == "__main__":
    tyro.cli(main)
