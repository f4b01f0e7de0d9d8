"""Scans and loops over ROS 1, between processes with a real roscore."""

import contextlib
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from sglpr_jax.live import ros1_wire
from sglpr_jax.live.ros_messages import CLOUD, EDGE, MARKERS, TRANSFORMS, decode_cloud, ros1_typestore
from sglpr_jax.live.sources import SourceOptions, open_source
from tests import bags
from tests.live.messages import LIVOX, POINTS
from tests.live.test_wires import LATE, until

ROSCORE = shutil.which("roscore")
real = pytest.mark.skipif(
    ROSCORE is None, reason="needs the program roscore (Debian: python3-roslaunch, python3-rospy)"
)
CHECKSUMS = {
    CLOUD: "1158d486dd51d683ce2f1be655c3c181",
    EDGE: "953b798c0f514ff060a53a3498ce6246",
    MARKERS: "d155b9ce5188fbaf89745847fd5882d7",
    TRANSFORMS: "94810edda583a504dfda3829e70d7eec",
}
"""Published by ROS with the definitions of messages."""
HERE = Path(__file__).parent
OURS = (sys.executable, "-m", "tests.live.ros1_ours")
TALKER = ("/usr/bin/python3", str(HERE / "ros1_talker.py"))
TIMEOUT_S = 200


def free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return found.getsockname()[1]


@pytest.fixture(scope="module")
def core(tmp_path_factory) -> Iterator[dict[str, str]]:
    """Environment of the processes that use a roscore."""
    port, home = free_port(), str(tmp_path_factory.mktemp("ros"))
    own = {"ROS_IP": "127.0.0.1", "ROS_HOME": home, "ROS_LOG_DIR": home, "ROS_MASTER_URI": f"http://127.0.0.1:{port}"}
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"} | own
    with running((str(ROSCORE), "-p", str(port)), environment, stdout=subprocess.DEVNULL, end=signal.SIGTERM):
        until(lambda: reached(port))
        yield environment


def reached(port: int) -> bool:
    with socket.socket() as found:
        return found.connect_ex(("127.0.0.1", port)) == 0


@contextlib.contextmanager
def running(
    command: tuple[str, ...], environment: dict[str, str], *, end: signal.Signals = signal.SIGKILL, **options
) -> Iterator[subprocess.Popen]:
    """Run a program until the end of the block."""
    with subprocess.Popen(command, env=environment, cwd=HERE.parents[1], text=True, **options) as process:
        try:
            yield process
        finally:
            process.send_signal(end)


def ours(what: str, environment: dict[str, str]) -> subprocess.CompletedProcess:
    options = {"cwd": HERE.parents[1], "env": environment, "capture_output": True, "text": True}
    return subprocess.run((*OURS, what), timeout=TIMEOUT_S, **options)


@pytest.mark.slow
@real
def test_scans_and_poses_come_over_ros_1(core):
    with running((*TALKER, "PointCloud2"), core):
        ended = ours("source", core)
    found = json.loads(ended.stdout)
    time, points, odometry = found["scan"]
    np.testing.assert_array_equal(points, np.arange(60, dtype=np.float32).reshape(20, 3))
    x, y, z = np.array(odometry)[:3, 3]  # its own pose, or the first one that came
    np.testing.assert_allclose((y, z), (0, 2), atol=1e-5)
    assert -1e-5 < x - 2 * (time - 100) < 0.1 + 1e-5
    assert found["topics"]["/points"] == [CLOUD]
    assert set(found["said"]) <= LATE, found["said"]
    assert not ended.stderr


@pytest.mark.slow
@real
def test_a_topic_with_another_type_is_reported_over_ros_1(core):
    with running((*TALKER, "LaserScan"), core):
        said = json.loads(ours("source", core).stdout)["said"]
    assert said["type"] == [f"/points: expected {CLOUD} or {LIVOX}, found sensor_msgs/msg/LaserScan; waiting"]


@pytest.mark.slow
@real
def test_results_reach_a_subscriber_that_comes_later_over_ros_1(core):
    """Three loops were published before, and a transform after each scan."""
    with running((*OURS, "sink"), core), running((*TALKER, "PointCloud2"), core, stdout=subprocess.PIPE) as talker:
        found: list[str] = []
        for line in talker.stdout:
            found.append(line.strip())
            if wanted(found):
                break
    assert wanted(found), found[-5:]


def wanted(lines: list[str]) -> bool:
    loops = sum(line.startswith("loop match/1000.250000000 ") for line in lines)
    assert loops <= 3
    return loops == 3 and "tf map odom" in lines and any(line.startswith("markers ") for line in lines)


@pytest.mark.slow
@real
def test_a_second_roscore_is_one_clear_error(core):
    said = f"ros1: expected one roscore in a process, found {core['ROS_MASTER_URI']} and http://other:11311"
    assert said in ours("another", core).stderr


@pytest.mark.parametrize("where", ["http://127.0.0.1:1", "nonsense"])
def test_a_roscore_that_is_missing_is_one_clear_error(where):
    rospy = type("rospy", (), {"core": type("core", (), {"is_initialized": staticmethod(lambda: False)})})
    with pytest.raises(ValueError, match=f"ros1: expected a running roscore at {where}, found none"):
        ros1_wire._start(rospy, where)


def test_without_rospy_one_line_says_what_to_install(monkeypatch, said, tmp_path):
    monkeypatch.setattr(ros1_wire, "DEBIAN", str(tmp_path))
    monkeypatch.setattr(ros1_wire.importlib.util, "find_spec", lambda name: None)
    monkeypatch.delitem(sys.modules, "rospy", raising=False)
    with pytest.raises(ImportError, match="ros1: expected the package rospy, found none; install python3-rospy"):
        open_source("ros1", SourceOptions(), said)


@pytest.mark.parametrize("kind", CHECKSUMS)
def test_checksums_of_types_are_those_of_ros_1(kind):
    assert ros1_typestore().generate_msgdef(kind, ros_version=1)[1] == CHECKSUMS[kind]


def test_scans_of_both_types_are_decoded():
    store = bags.typestore("ros1")
    found = bags.cloud("ros1", 12.5, POINTS)
    header, records = decode_cloud(bytes(store.serialize_ros1(found, CLOUD)), CLOUD, cdr=False)
    assert header.time == 12.5
    np.testing.assert_array_equal(records.points, POINTS)
    point = store.types["livox_ros_driver2/msg/CustomPoint"]
    rows = [point(i, *map(float, xyz), 9, 0, 1) for i, xyz in enumerate(POINTS)]
    head = bags.header("ros1", 12.5, "lidar")
    livox = store.types[LIVOX](head, 7, len(rows), 1, np.zeros(3, np.uint8), rows)
    _, records = decode_cloud(bytes(store.serialize_ros1(livox, LIVOX)), LIVOX, cdr=False)
    np.testing.assert_array_equal(records.points, POINTS)
