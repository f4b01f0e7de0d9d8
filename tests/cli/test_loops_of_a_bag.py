"""The whole way of a new user: an mcap and odometry in, a graph out that is right and that other programs read."""

from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from sglpr_jax.loops.graph_files import read_g2o, read_tum, write_tum
from sglpr_jax.loops.optimization import trajectory_error
from sglpr_jax.loops.transforms import inverse, transform
from sglpr_jax.sim import Sensor
from sglpr_jax.sim.recording import SimulatedRecording, simulate_recording

pytestmark = pytest.mark.slow
SCANS = 120
SENSOR = Sensor(elevations_deg=tuple(np.linspace(2, -24, 24)), azimuth_steps=360)
START_S = 1_700_000_000


@pytest.fixture(scope="module")
def drive() -> SimulatedRecording:
    return simulate_recording("08", scans=SCANS, sensor=SENSOR, seed=3)


@pytest.fixture(scope="module")
def mcap(drive, tmp_path_factory) -> Path:
    """The scans as PointCloud2 messages of 16 bytes a point, in a lone file."""
    types = get_typestore(Stores.ROS2_HUMBLE)
    of = types.types
    fields = [
        of["sensor_msgs/msg/PointField"](name=name, offset=4 * i, datatype=7, count=1)
        for i, name in enumerate(("x", "y", "z", "intensity"))
    ]
    folder = tmp_path_factory.mktemp("bag")
    with Writer(folder / "drive", version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        topic = bag.add_connection("/points", "sensor_msgs/msg/PointCloud2", typestore=types)
        for i in range(SCANS):
            points = np.pad(drive.points(i), ((0, 0), (0, 1))).astype(np.float32)
            stamp = START_S * 10**9 + round(drive.times[i] * 1e9)
            time = of["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
            message = of["sensor_msgs/msg/PointCloud2"](
                header=of["std_msgs/msg/Header"](stamp=time, frame_id="lidar"),
                height=1,
                width=len(points),
                fields=fields,
                is_bigendian=False,
                point_step=16,
                row_step=16 * len(points),
                data=points.view(np.uint8).reshape(-1),
                is_dense=True,
            )
            bag.write(topic, stamp, types.serialize_cdr(message, topic.msgtype))
    return next((folder / "drive").glob("*.mcap")).rename(folder / "drive.mcap")


@pytest.fixture(scope="module")
def odometry(drive) -> np.ndarray:
    """Begins with the identity, 1 % too long and turned by a quarter of a degree a scan."""
    poses = [np.eye(4)]
    for step in inverse(drive.poses.world_from_lidar[:-1]) @ drive.poses.world_from_lidar[1:]:
        step = step.copy()
        step[:3, 3] *= 1.01
        poses.append(poses[-1] @ step @ transform(0.0, 0.0, np.radians(0.02)))
    return np.stack(poses)


def test_from_an_mcap_to_a_graph_and_a_corrected_trajectory(command, drive, mcap, odometry, tmp_path):
    write_tum(tmp_path / "odometry.tum", odometry, drive.times)
    out = tmp_path / "found"
    options = ("--odometry", tmp_path / "odometry.tum", "--out", out, "--optimize", "--min-probability", "0.9")
    ended = command("loops", mcap, *options)
    assert ended.status == 0, ended.error
    assert f"drive: {SCANS} scans" in ended.error and "/points of drive.mcap" in ended.error
    assert "estimated from the ground" in ended.error

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
    assert page.count("data:image/png;base64,") >= 4
