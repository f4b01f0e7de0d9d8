"""Scans come from a growing folder and from a bag once each, in order, with their times and poses."""

import os
import time
from pathlib import Path

import numpy as np
import pytest

from sglpr_jax.live.sinks import SinkOptions, open_sink
from sglpr_jax.live.sources import SourceOptions, folder, open_source
from sglpr_jax.live.sources.growing_poses import GrowingPoses
from sglpr_jax.pose_graph.files import write_tum
from sglpr_jax.se3 import transform
from tests.bags import CLOUD, cloud, header, typestore, write_bag

POINTS = np.random.default_rng(0).normal(size=(300, 3)).astype(np.float32)
STAMP = 1_700_000_000.0


def scan(path: Path, points: int = 300) -> Path:
    np.pad(POINTS[:points], ((0, 0), (0, 1))).astype("<f4").tofile(path)
    return path


def taken(source, count: int, timeout_s: float = 10.0) -> list:
    """The next scans of a source, without the pauses."""
    found, end = [], time.monotonic() + timeout_s
    for frame in source.frames():
        found += [] if frame is None else [frame]
        if len(found) >= count or time.monotonic() > end:
            break
    return found


def looked(source, seconds: float) -> list:
    """The scans that come within a time."""
    return taken(source, 10**9, seconds)


@pytest.fixture
def incoming(tmp_path):
    path = tmp_path / "incoming"
    path.mkdir()
    return path


def test_scans_of_a_folder_come_in_order_once_they_are_complete(incoming, said):
    source = open_source(f"folder:{incoming}", SourceOptions(), said)
    assert looked(source, 0.1) == []
    for i in (10, 9):
        scan(incoming / f"{STAMP + i}.bin")
    first, second = taken(source, 2)
    assert (first.time, second.time) == (STAMP + 9, STAMP + 10) and first.record.name.endswith("09.0.bin")
    np.testing.assert_array_equal(first.record.points, POINTS)
    assert first.odometry is None and source.dropped == 0
    with (incoming / "1700000011.0.bin").open("wb") as file:
        content = (incoming / "1700000010.0.bin").read_bytes()
        for start in range(0, len(content), 800):
            file.write(content[start : start + 800])
            file.flush()
            assert looked(source, folder.LOOK_S / 2) == [] or start + 800 >= len(content)
    assert [frame.time for frame in taken(source, 1)] == [STAMP + 11] and not said


def test_a_folder_is_continued_after_the_last_scan_of_the_map(incoming, said):
    paths = [scan(incoming / f"{i}.bin") for i in range(4)]
    known = {str(paths[1].resolve())}
    source = open_source(f"folder:{incoming}", SourceOptions(taken=known.__contains__), said)
    assert [Path(frame.record.name).name for frame in looked(source, 0.5)] == ["2.bin", "3.bin"]


def test_a_scan_that_cannot_be_read_is_reported_and_the_others_come(incoming, said):
    scan(incoming / "0.bin")
    (incoming / "1.bin").write_bytes(b"12345")
    scan(incoming / "2.bin")
    (incoming / "3.bin").touch()
    for path in incoming.iterdir():
        os.utime(path, (STAMP, STAMP))
    source = open_source(f"folder:{incoming}", SourceOptions(), said)
    assert [Path(frame.record.name).name for frame in looked(source, 1.0)] == ["0.bin", "2.bin"]
    assert said.kinds == ["scan", "scan"] and "1.bin" in said[0][1]


def test_poses_of_a_folder_are_those_of_their_line_or_time(incoming, tmp_path, said):
    poses = np.stack([transform(float(i), 0.0, 0.1 * i) for i in range(4)])
    write_tum(tmp_path / "poses.tum", poses, STAMP + np.arange(4.0))
    for i in (0.5, 2.0):
        scan(incoming / f"{STAMP + i}.bin")
    options = SourceOptions(poses=tmp_path / "poses.tum")
    first, second = taken(open_source(f"folder:{incoming}", options, said), 2)
    np.testing.assert_allclose(first.odometry, transform(0.5, 0.0, 0.05), atol=1e-6)
    np.testing.assert_allclose(second.odometry, poses[2], atol=1e-6)


def test_a_file_of_poses_grows_and_a_damaged_line_costs_its_own_scan(tmp_path):
    path = tmp_path / "poses.txt"
    found = GrowingPoses(path, "lidar", "auto")
    found.look()
    assert found.of(0, None) is None
    row = np.eye(4)[:3].reshape(-1)
    with path.open("w") as file:
        for i in range(3):
            row[3] = i
            file.write("# comment\n" * (i == 0) + ("broken" if i == 1 else " ".join(map(str, row))) + "\n")
        file.write("1 0 0")  # not whole yet
    with pytest.raises(ValueError, match=r"poses.txt, line 3: expected 12 numbers, found 1"):
        found.look()
    found.look()
    assert len(found) == 3 and found.of(1, None) is None and found.of(3, None) is None
    assert found.of(2, None)[0, 3] == 2 and found.of(0, None)[0, 3] == 0
    with pytest.raises(ValueError, match="pass --pose-format kitti or lidar"):
        GrowingPoses(path, "auto", "auto").look()


def odometry(seconds: float, x: float):
    store = typestore("ros2").types

    def of(name: str, **fields):
        return store[f"geometry_msgs/msg/{name}"](**fields)

    turn = of("Quaternion", x=0.0, y=0.0, z=float(np.sin(x / 20)), w=float(np.cos(x / 20)))
    pose = of("Pose", position=of("Point", x=x, y=0.0, z=0.0), orientation=turn)
    return of("PoseStamped", header=header("ros2", seconds, "odom"), pose=pose)


@pytest.fixture
def bag(tmp_path):
    """Ten clouds at 20 Hz, with poses."""
    messages = []
    for i in range(10):
        at = STAMP + 0.05 * i
        messages += [("/points", CLOUD, at, cloud("ros2", at, POINTS + i))]
        messages += [("/odom", "geometry_msgs/msg/PoseStamped", at, odometry(at, float(i)))]
    return write_bag(tmp_path / "drive", "ros2", messages)


def test_a_bag_is_replayed_as_fast_as_possible(bag, said):
    options = SourceOptions(rate=0.0, sensor_height=1.5, odometry_topic="/odom")
    frames = list(open_source(f"bag:{bag}", options, said).frames())
    np.testing.assert_allclose([frame.time for frame in frames], STAMP + 0.05 * np.arange(10))
    assert [frame.odometry[0, 3] for frame in frames] == pytest.approx(range(10), abs=1e-6)
    assert frames[3].record.mounting.height_m == 1.5 and frames[3].record.name.endswith("scan 000003")
    known = {frames[3].record.name, frames[6].record.name}
    rest = open_source(f"bag:{bag}", SourceOptions(rate=0.0, taken=known.__contains__), said)
    assert [frame.time for frame in rest.frames()] == [frame.time for frame in frames[7:]]


def test_a_bag_is_replayed_at_its_own_pace_and_drops_what_is_late(bag, said):
    source = open_source(f"bag:{bag}", SourceOptions(), said)
    begin, found = time.monotonic(), []
    for frame in source.frames():
        if frame is not None:
            found.append(frame)
            time.sleep(0.11)
    assert time.monotonic() - begin > 0.45 and source.dropped > 0
    assert len(found) + source.dropped == 10 and found[-1].time == pytest.approx(STAMP + 0.45)
    assert found[0].odometry is None


@pytest.mark.parametrize("text", ["", "ros", "folders:x"])
def test_an_unknown_source_or_sink_is_refused(text, said):
    with pytest.raises(ValueError, match="expected one of the sources folder, bag, dds, zenoh, ros1, found"):
        open_source(text, SourceOptions(), said)
    with pytest.raises(ValueError, match="expected one of the sinks json, dds, zenoh, ros1, rerun, found"):
        open_sink(text, SinkOptions(), said)


def test_a_missing_folder_topic_and_extra_are_named(bag, tmp_path, said, monkeypatch):
    with pytest.raises(FileNotFoundError, match=r"folder:.*: expected a folder"):
        open_source(f"folder:{tmp_path}/none", SourceOptions(), said)
    with pytest.raises(ValueError, match=r"/other"):
        open_source(f"bag:{bag}", SourceOptions(odometry_topic="/other"), said)
    monkeypatch.setattr("sglpr_jax.live.sources.importlib.import_module", missing)
    with pytest.raises(ImportError, match=r"dds: expected the package cyclonedds, found none; pip install .*\[live\]"):
        open_source("dds", SourceOptions(), said)


def missing(name: str):
    raise ModuleNotFoundError("No module named 'cyclonedds'", name="cyclonedds")
