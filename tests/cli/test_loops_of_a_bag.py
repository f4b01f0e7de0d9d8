"""The whole way of a new user: an mcap and odometry in, a graph out that is right and that other programs read."""

from pathlib import Path

import numpy as np
import pytest
from bags import TRANSFORMS, header, transforms, typestore, write_bag

from sglpr_jax.data.formats.pose_files import read_tum
from sglpr_jax.maps.place_map import PlaceMap
from sglpr_jax.pose_graph.files import read_g2o, write_tum
from sglpr_jax.pose_graph.optimize import trajectory_error
from sglpr_jax.se3 import inverse, quaternions, transform
from sglpr_jax.sim.recording import SimulatedRecording, simulate_recording
from sglpr_jax.sim.sensor import Sensor

from .conftest import assert_one_line_error

pytestmark = pytest.mark.slow
SCANS = 120
SENSOR = Sensor(elevations_deg=tuple(np.linspace(2, -24, 24)), azimuth_steps=360)
START_S = 1_700_000_000.0
BASE = ("base_link", "lidar", (1.0, 0.0, 0.5), (0, 0, 0, 1))
"""How the LiDAR is mounted, as tf says it."""


@pytest.fixture(scope="module")
def drive() -> SimulatedRecording:
    return simulate_recording("08", scans=SCANS, sensor=SENSOR, seed=3)


@pytest.fixture(scope="module")
def odometry(drive) -> np.ndarray:
    """Odometry of wheels: half a per cent too long and turned by 5 degrees every 100 m, ten times the default drift."""
    poses = [np.eye(4)]
    for step in inverse(drive.poses.world_from_lidar[:-1]) @ drive.poses.world_from_lidar[1:]:
        step = step.copy()
        turned = np.radians(0.05) * np.linalg.norm(step[:3, 3])
        step[:3, 3] *= 1.005
        poses.append(poses[-1] @ step @ transform(0.0, 0.0, float(turned)))
    return np.stack(poses)


@pytest.fixture(scope="module")
def mcap(drive, odometry, tmp_path_factory) -> Path:
    """The scans as PointCloud2 messages of 16 bytes a point, odometry of a base 1 m behind the LiDAR, and tf."""
    store = typestore("mcap").types
    messages = [("/tf_static", TRANSFORMS, START_S, transforms("mcap", START_S, [BASE]))]
    base_from_lidar = np.eye(4)
    base_from_lidar[:3, 3] = BASE[2]
    for i, pose in enumerate(odometry @ inverse(base_from_lidar)):
        time = START_S + float(drive.times[i])
        points = np.pad(drive.points(i), ((0, 0), (0, 1))).astype(np.float32)
        messages.append(
            ("/points", "sensor_msgs/msg/PointCloud2", time, cloud(store, header("mcap", time, "lidar"), points))
        )
        messages.append(("/odom", "nav_msgs/msg/Odometry", time, moved(store, time, pose)))
    folder = write_bag(tmp_path_factory.mktemp("bag") / "drive", "mcap", messages)
    return next(folder.glob("*.mcap")).rename(folder.parent / "drive.mcap")


def cloud(store, about, points):
    fields = [
        store["sensor_msgs/msg/PointField"](name=name, offset=4 * i, datatype=7, count=1)
        for i, name in enumerate(("x", "y", "z", "intensity"))
    ]
    return store["sensor_msgs/msg/PointCloud2"](
        header=about,
        height=1,
        width=len(points),
        fields=fields,
        is_bigendian=False,
        point_step=16,
        row_step=16 * len(points),
        data=points.view(np.uint8).reshape(-1),
        is_dense=True,
    )


def moved(store, time, pose):
    at = store["geometry_msgs/msg/Point"](*pose[:3, 3].tolist())
    turned = store["geometry_msgs/msg/Quaternion"](*quaternions(pose[None])[0].tolist())
    zero = store["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0)
    with_covariance = store["geometry_msgs/msg/PoseWithCovariance"], store["geometry_msgs/msg/TwistWithCovariance"]
    return store["nav_msgs/msg/Odometry"](
        header=header("mcap", time, "odom"),
        child_frame_id="base_link",
        pose=with_covariance[0](pose=store["geometry_msgs/msg/Pose"](at, turned), covariance=np.zeros(36)),
        twist=with_covariance[1](twist=store["geometry_msgs/msg/Twist"](zero, zero), covariance=np.zeros(36)),
    )


@pytest.mark.parametrize("given", ["a file", "the bag itself"])
def test_from_an_mcap_to_a_graph_and_a_corrected_trajectory(command, drive, mcap, odometry, tmp_path, given):
    write_tum(tmp_path / "odometry.tum", odometry, drive.times)
    out = tmp_path / "found"
    named = mcap if given == "the bag itself" else tmp_path / "odometry.tum"
    options = ("--odometry", named, "--out", out, "--optimize")
    ended = command("loops", mcap, *options)
    assert ended.status == 0, ended.error
    assert f"drive: {SCANS} scans" in ended.error and "/points of drive.mcap" in ended.error
    assert "estimated from the ground" in ended.error
    assert "poses: /odom (120 poses of base_link in odom, interpolated, moved to lidar by tf)" in ended.error

    graph = read_g2o(out / "loops.g2o")
    assert sorted(graph.poses) == list(range(SCANS))
    np.testing.assert_allclose(np.stack([graph.poses[i] for i in range(SCANS)]), odometry, atol=1e-4)
    steps, loops = graph.edges[: SCANS - 1], graph.edges[SCANS - 1 :]
    assert [edge[:2] for edge in steps] == [(i, i + 1) for i in range(SCANS - 1)]
    poses = drive.poses.world_from_lidar
    assert len(loops) >= 5
    for match, query, match_from_query, information in loops:
        error = inverse(inverse(poses[match]) @ poses[query]) @ match_from_query
        assert np.linalg.norm(error[:2, 3]) < 1.0 and (np.linalg.eigvalsh(information) > 0).all()

    corrected, times = read_tum(out / "trajectory-optimized.tum")
    np.testing.assert_allclose(times, START_S + drive.times, atol=1e-5)
    true = drive.positions
    assert trajectory_error(corrected, true) < trajectory_error(odometry, true)
    page = (out / "index.html").read_text()
    assert page.count("data:image/png;base64,") >= 3
    judged = given == "a file"  # by the poses of the bag, but not where these are the odometry themselves
    assert ("RMSE after alignment with /odom" in page) == judged
    assert ("is not known: the recording has no poses" in page) != judged


def test_a_map_takes_the_poses_of_its_bag(command, mcap, odometry, tmp_path):
    out = tmp_path / "town.safetensors"
    ended = command("map", mcap, "--poses", mcap, "--spacing-m", "40", "--out", out)
    assert ended.status == 0, ended.error
    places = PlaceMap.load(out)
    assert 3 <= len(places) <= 20
    rows = [int(name.removeprefix("drive/")) for name in places.index.ids]
    np.testing.assert_allclose(places.world_from_place, odometry[rows], atol=1e-4)


def test_a_bag_without_rotations_is_no_odometry_and_another_bag_neither(command, drive, mcap, tmp_path):
    store = typestore("ros1").types
    points = np.pad(drive.points(0), ((0, 0), (0, 1))).astype(np.float32)
    messages = [cloud(store, header("ros1", START_S, "lidar"), points) for _ in range(2)]
    clouds = [("/points", "sensor_msgs/msg/PointCloud2", START_S + i, message) for i, message in enumerate(messages)]
    bag = write_bag(tmp_path / "scans.bag", "ros1", clouds)
    run = ("loops", bag, "--out", tmp_path / "found", "--odometry")
    assert_one_line_error(command(*run, bag), "scans.bag: expected a bag with poses", "found no poses")
    assert_one_line_error(command(*run, mcap), "drive.mcap: expected a file of odometry", "found another bag")
    still = write_bag(
        tmp_path / "still.bag", "ros1", [("/tf", TRANSFORMS, START_S, transforms("ros1", START_S, [BASE]))]
    )
    ended = command("loops", still, "--out", tmp_path / "found")
    assert_one_line_error(ended, "still.bag: expected a topic of point clouds", "found /tf (tf2_msgs/msg/TFMessage)")
    assert not (tmp_path / "found").exists()
