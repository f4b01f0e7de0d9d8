"""Scans come from a growing folder once each, in order, with their times and poses."""

import os
import time
from pathlib import Path

import numpy as np
import pytest

from sglpr_jax.live import folder
from sglpr_jax.live.folder import FolderSource, GrowingPoses
from sglpr_jax.live.options import LiveOptions
from sglpr_jax.live.sources_and_sinks import open_source
from sglpr_jax.pose_graph.files import write_tum
from sglpr_jax.se3 import transform

POINTS = (np.random.default_rng(0).normal(size=(300, 3)) * [3, 3, 1]).astype(np.float32)
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
    source = open_source(f"folder:{incoming}", LiveOptions(), said)
    assert looked(source, 0.1) == []
    for i in (10, 9):
        scan(incoming / f"{STAMP + i}.bin")
    first, second = taken(source, 2)
    assert (first.time, second.time) == (STAMP + 9, STAMP + 10) and first.scan.name.endswith("09.0.bin")
    np.testing.assert_array_equal(first.scan.points, POINTS)
    assert first.odometry is None and source.dropped == 0
    with (incoming / "1700000011.0.bin").open("wb") as file:
        content = (incoming / "1700000010.0.bin").read_bytes()
        for start in range(0, len(content), 800):
            file.write(content[start : start + 800])
            file.flush()
            assert looked(source, folder.POLL_S / 2) == [] or start + 800 >= len(content)
    assert [frame.time for frame in taken(source, 1)] == [STAMP + 11] and not said


def test_a_folder_is_continued_after_the_last_scan_of_the_map(incoming, said):
    paths = [scan(incoming / f"{i}.bin") for i in range(4)]
    known = {str(paths[1].resolve())}
    source = open_source(f"folder:{incoming}", LiveOptions(), said, map_names=known)
    assert [Path(frame.scan.name).name for frame in looked(source, 0.5)] == ["2.bin", "3.bin"]


def test_removed_scans_of_the_map_are_an_error_if_their_number_is_the_line_of_their_pose(incoming, tmp_path, said):
    options, place = LiveOptions(poses=tmp_path / "poses.tum"), incoming.resolve()
    scan(incoming / "1.bin")
    open_source(f"folder:{incoming}", options, said, map_names={f"{place}/{STAMP}.bin", f"{place.parent}/0.bin"})
    with pytest.raises(ValueError, match=r"incoming: expected all scans of the map, .*found 1 removed \(0\.bin\)"):
        open_source(f"folder:{incoming}", options, said, map_names={f"{place}/0.bin", f"{place}/1.bin"})


def test_the_folder_is_not_listed_again_while_scans_wait(incoming, said, monkeypatch):
    for i in range(5):
        os.utime(scan(incoming / f"{i}.bin"), (STAMP, STAMP))
    source, listings, list_folder = open_source(f"folder:{incoming}", LiveOptions(), said), [], FolderSource._list
    monkeypatch.setattr(FolderSource, "_list", lambda self: listings.append(list_folder(self)) or listings[-1][:])
    assert len(taken(source, 5)) == 5 and len(listings) == 1
    monkeypatch.setattr(folder, "COMPLETE_AFTER_S", 60.0)
    scan(incoming / "5.bin")
    changed_ns = incoming.stat().st_mtime_ns
    assert len(taken(source, 1)) == 1 and [path.name for path in listings[-1]] == ["5.bin"]
    scan(incoming / "6.bin")
    os.utime(incoming, ns=(changed_ns, changed_ns))  # as on a disk whose times are coarse
    monkeypatch.setattr(folder, "COMPLETE_AFTER_S", 0.0)
    assert len(taken(source, 1)) == 1


def test_a_scan_that_cannot_be_read_is_reported_and_the_others_come(incoming, said):
    scan(incoming / "0.bin")
    (incoming / "1.bin").write_bytes(b"12345")
    scan(incoming / "2.bin")
    (incoming / "3.bin").touch()
    for path in incoming.iterdir():
        os.utime(path, (STAMP, STAMP))
    source = open_source(f"folder:{incoming}", LiveOptions(), said)
    assert [Path(frame.scan.name).name for frame in looked(source, 1.0)] == ["0.bin", "2.bin"]
    assert said.kinds == ["scan", "scan"] and "1.bin" in said[0][1]


def test_poses_of_a_folder_are_those_of_their_line_or_time(incoming, tmp_path, said):
    poses = np.stack([transform(float(i), 0.0, 0.1 * i) for i in range(4)])
    write_tum(tmp_path / "poses.tum", poses, STAMP + np.arange(4.0))
    with (tmp_path / "poses.tum").open("a") as file:
        print("broken", file=file)  # costs no scan its pose
    for i in (0.5, 2.0):
        os.utime(scan(incoming / f"{STAMP + i}.bin"), (STAMP, STAMP))
    options = LiveOptions(poses=tmp_path / "poses.tum")
    first, second = taken(open_source(f"folder:{incoming}", options, said), 2)
    np.testing.assert_allclose(first.odometry, transform(0.5, 0.0, 0.05), atol=1e-6)
    np.testing.assert_allclose(second.odometry, poses[2], atol=1e-6)
    assert said.kinds == ["poses"]


def test_a_scan_waits_for_a_pose_at_its_time_and_takes_the_last_one_only_if_it_is_late(tmp_path):
    write_tum(
        tmp_path / "poses.tum", np.stack([transform(float(i), 0.0, 0.0) for i in range(4)]), STAMP + np.arange(4) / 10
    )
    found = GrowingPoses(tmp_path / "poses.tum", "auto", "auto")
    found.read_appended()
    assert found.of(0, STAMP + 0.35) is None
    np.testing.assert_allclose(found.of(0, STAMP + 0.35, is_late=True), transform(3.0, 0.0, 0.0))
    np.testing.assert_allclose(found.of(0, STAMP + 0.3), transform(3.0, 0.0, 0.0), atol=1e-4)


def test_a_scan_whose_file_has_a_date_in_the_future_does_not_wait_longer(incoming, tmp_path, said, monkeypatch):
    monkeypatch.setattr(folder, "MAX_POSE_WAIT_S", 0.1)
    ahead = time.time() + 3600
    os.utime(scan(incoming / "0.bin"), (ahead, ahead))
    source = open_source(f"folder:{incoming}", LiveOptions(poses=tmp_path / "poses.tum"), said)
    assert [frame.odometry for frame in taken(source, 1, 5.0)] == [None]


def test_old_poses_are_dropped_and_a_file_that_begins_anew_is_read_from_its_beginning(tmp_path, monkeypatch):
    monkeypatch.setattr(folder, "KEPT_POSES", 50)
    path = tmp_path / "poses.tum"
    found, poses = GrowingPoses(path, "tum", "auto"), np.stack([transform(float(i), 0.0, 0.0) for i in range(200)])
    write_tum(path, poses, STAMP + np.arange(200.0))
    found.read_appended()
    assert found.of(100, None)[0, 3] == 100 and found.of(101, None)[0, 3] == 101
    assert found.of(0, STAMP + 198)[0, 3] == pytest.approx(198, abs=1e-3) and len(found._poses) == 52
    assert found.of(0, STAMP + 180.5)[0, 3] == pytest.approx(180.5, abs=1e-3)  # of a scan that comes out of order
    write_tum(path, poses[:3], STAMP + np.arange(3.0))
    with pytest.raises(ValueError, match=r"poses.tum: expected a file that grows, found one that begins anew"):
        found.read_appended()
    assert found.of(2, None)[0, 3] == 2


def test_a_file_of_poses_grows_and_a_damaged_line_costs_its_own_scan(tmp_path):
    path = tmp_path / "poses.txt"
    found = GrowingPoses(path, "lidar", "auto")
    found.read_appended()
    assert found.of(0, None) is None
    row = np.eye(4)[:3].reshape(-1)
    with path.open("w") as file:
        for i in range(3):
            row[3] = i
            file.write("# comment\n" * (i == 0) + ("broken" if i == 1 else " ".join(map(str, row))) + "\n")
        file.write("1 0 0")  # not whole yet
    with pytest.raises(ValueError, match=r"poses.txt, line 3: expected 12 numbers, found 1"):
        found.read_appended()
    found.read_appended()
    assert found.of(1, None) is None and found.of(3, None) is None
    assert found.of(2, None)[0, 3] == 2 and found.of(0, None)[0, 3] == 0
    with pytest.raises(ValueError, match="pass --pose-format kitti or lidar"):
        GrowingPoses(path, "auto", "auto").read_appended()


@pytest.mark.parametrize("format", ["tum", "lidar"])
def test_a_line_of_zeros_is_no_pose(tmp_path, format):
    path = tmp_path / "poses.txt"
    path.write_text("# comment\n" + "0 " * (8 if format == "tum" else 12) + "\n")
    found = GrowingPoses(path, format, "auto")
    with pytest.raises(ValueError, match=r"poses\.txt, line 2: expected a rotation .*, found 0 0 0 0"):
        found.read_appended()
    assert found.of(0, None) is None
