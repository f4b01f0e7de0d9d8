"""A map that is continued by another process is that of one process, whatever the odometry does meanwhile."""

import dataclasses
import os
import shutil

import numpy as np
import pytest

from sglpr_jax.data.formats.pose_files import read_tum
from sglpr_jax.data.mounting import Mounting
from sglpr_jax.frame_log import MARK
from sglpr_jax.live.live_map import FRAMES_LOG, LiveMap
from sglpr_jax.live.result_files import write_results
from sglpr_jax.loops.comparison import Fits
from sglpr_jax.loops.config import DetectorConfig
from sglpr_jax.loops.detector import LoopDetector
from sglpr_jax.loops.keyframes import Keyframe
from sglpr_jax.pose_graph.files import LOOPS_JSONL, read_loops_jsonl
from sglpr_jax.registration.bev_search import CorrelationPeak
from sglpr_jax.se3 import inverse, transform
from tests.live.conftest import BEGIN, SCANS, live_frame

CONFIG = DetectorConfig(min_probability=0.5)
HALF = 20
DRAW = np.random.default_rng(0)
FITS = Fits(np.array([1, 4]), CorrelationPeak(*DRAW.normal(size=(5, 2))))
SEEN = Keyframe(np.ones(4, np.float32), np.ones((6, 6), np.uint8), Mounting(1.5))


def opened(params, folder, said, **more) -> LiveMap:
    return LiveMap(LoopDetector(params, config=CONFIG), folder, report=said, **more)


def pairs(loops) -> list[tuple[int, int]]:
    return [(one.query, one.match) for one in loops]


@pytest.fixture(scope="module")
def whole(drive, params, tmp_path_factory):
    """Folder and edges of a map of the drive with odometry, made by one process."""
    folder = tmp_path_factory.mktemp("whole")
    live = opened(params, folder, lambda kind, text: None)
    assert live.restore() == []
    poses = drive.poses.world_from_lidar
    edges = [edge for i in range(SCANS) for edge in live.add(live_frame(drive, i, pose=poses[i]))]
    live.close()
    return folder, edges


@pytest.mark.slow
def test_edges_of_a_drive_are_true_and_on_disk(drive, whole):
    folder, edges = whole
    assert len(edges) > 3
    for edge in edges:
        assert np.linalg.norm(drive.positions[edge.query] - drive.positions[edge.match]) < 12
        assert edge.query_time - edge.match_time == pytest.approx(drive.times[edge.query] - drive.times[edge.match])
        assert np.array_equal(edge.world_from_match, drive.poses.world_from_lidar[edge.match])
    assert pairs(read_loops_jsonl(folder / LOOPS_JSONL)) == pairs(edges)


@pytest.mark.slow
def test_a_map_is_recalled_without_its_unfinished_end(params, whole, tmp_path, said):
    folder, edges = whole
    content, lines = (folder / FRAMES_LOG).read_bytes(), (folder / LOOPS_JSONL).read_bytes()
    (tmp_path / FRAMES_LOG).write_bytes(content[:-5])
    kept = len(edges) - 4
    (tmp_path / LOOPS_JSONL).write_bytes(b"".join(lines.splitlines(True)[:kept]) + lines[:9])  # the next line is cut
    live = opened(params, tmp_path, said)
    missed = live.restore()
    assert len(live) == SCANS - 1 and said.kinds == ["damaged", "recall", "log"]
    found = pairs(live.detector.loops)
    assert kept < len(found) <= len(edges) and found == pairs(edges)[: len(found)]
    assert pairs(missed) == found[kept:] and pairs(read_loops_jsonl(tmp_path / LOOPS_JSONL)) == found
    assert live.names == {f"scan {i}" for i in range(SCANS - 1)}
    live.detector.config = dataclasses.replace(live.detector.config, max_places=9)
    live._forget_results()
    assert pairs(live.loops) == found and pairs(live.detector.loops) == found[-9:]
    live.close()
    assert (tmp_path / FRAMES_LOG).read_bytes() == content[:-5]


@pytest.mark.slow
def test_a_damaged_scan_costs_itself_alone(drive, params, whole, tmp_path, said):
    folder, edges = whole
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    content = bytearray((folder / FRAMES_LOG).read_bytes())
    content[content.index(MARK, len(content) * 9 // 10) + 50] ^= 1
    (tmp_path / FRAMES_LOG).write_bytes(content)
    live = opened(params, tmp_path, said)
    live.restore()
    assert said.kinds[0] == "damaged" and "lost before the last one: 1" in said[0][1]
    assert len(live) == SCANS and len(set(live.detector.finder.motion.segments.tolist())) == 1
    lost = [i for i in range(SCANS) if f"scan {i}" not in live.names]
    assert len(lost) == 1 and np.array_equal(live.stamps[lost[0]], live.stamps[lost[0] + 1])
    assert len(set(pairs(live.detector.loops)) & set(pairs(edges))) > len(edges) // 2
    live.close()


@pytest.mark.slow
def test_scans_between_keyframes_are_counted_and_recalled(drive, params, tmp_path, said):
    """Every scan arrives twice, the second time 0.1 m ahead."""
    live = opened(params, tmp_path, said, expects_odometry=True)
    live.restore()
    for i in range(12):
        for ahead in (0.0, 0.1):
            pose, seconds = drive.poses.world_from_lidar[i] @ transform(ahead, 0.0, 0.0), float(drive.times[i]) + ahead
            live.add(live_frame(drive, i, pose=pose, time=BEGIN + seconds, received=seconds))
    live.close()
    recalled = opened(params, tmp_path, said, expects_odometry=True)
    recalled.restore()
    for one in (live, recalled):
        assert len(one) == len(one.odometry) == len(one.stamps) == 24 == len(one.trajectory.poses)
        assert one.detector.finder.rows.tolist() == list(range(0, 24, 2))
    np.testing.assert_array_equal(live.odometry, recalled.odometry)
    paths = write_results(recalled, tmp_path)
    assert len(read_tum(next(path for path in paths if path.name == "trajectory.tum"))[0]) == 24
    recalled.close()


@pytest.mark.slow
def test_loops_to_scans_before_a_restart_are_found_if_the_odometry_begins_again(drive, params, whole, tmp_path, said):
    poses = drive.poses.world_from_lidar
    content = (whole[0] / FRAMES_LOG).read_bytes()
    (tmp_path / FRAMES_LOG).write_bytes(content[: content.index(MARK + (HALF + 1).to_bytes(4, "little"))])
    live = opened(params, tmp_path, said, expects_odometry=True)
    assert live.map_from_world is None and live.restore() == [] and len(live) == HALF
    edges, again = [], inverse(poses[HALF]) @ poses[HALF:]
    for i, pose in enumerate(again, HALF):
        edges += live.add(live_frame(drive, i, pose=pose, received=float(drive.times[i]) + 1e9))
    assert ("restart", "the odometry is taken as unknown, and begins in a frame of its own after the restart") in said
    across = [edge for edge in edges if edge.match < HALF]
    assert len(across) > 3
    for edge in across:
        assert np.linalg.norm(drive.positions[edge.query] - drive.positions[edge.match]) < 12
        assert edge.world_from_match is None and np.array_equal(edge.world_from_query, again[edge.query - HALF])
        assert edge.odometry_frame == whole[1][0].odometry_frame + 1
    corrected = live.trajectory.poses
    apart = np.linalg.norm(corrected[:, :3, 3] - poses[:, :3, 3], axis=1)
    assert apart[:HALF].max() < 1 and apart[HALF:].max() < 5
    np.testing.assert_allclose(live.map_from_world @ again[-1], corrected[-1], atol=1e-9)
    paths = {path.name for path in write_results(live, tmp_path)}
    tables = {"loops.g2o", "loops.jsonl", "loops.csv", "rejected.jsonl"}
    assert paths == {*tables, "trajectory.tum", "trajectory-optimized.tum"}
    assert len(read_tum(tmp_path / "trajectory-optimized.tum")[0]) == len(live)
    steps = [line.split()[1:3] for line in (tmp_path / "loops.g2o").read_text().splitlines() if line.startswith("EDGE")]
    ends = [[str(frame) for frame in sorted((edge.query, edge.match))] for edge in edges]
    odometry = [step for step in steps if sorted(step, key=int) not in ends]
    assert [str(HALF - 1), str(HALF)] not in odometry and [str(HALF), str(HALF + 1)] in odometry
    live.close()


def test_a_map_of_other_settings_is_not_continued(params, tmp_path, said):
    opened(params, tmp_path, said).close()
    with pytest.raises(ValueError, match=r"frames.log: .*same settings, found another sensor_height; use the settings"):
        opened(params, tmp_path, said, sensor_height=2.0)


def test_scans_of_nothing_are_left_out_or_hold_no_place(drive, params, tmp_path, said):
    live = opened(params, tmp_path, said)
    live.restore()
    frame = live_frame(drive, 0)
    nothing = dataclasses.replace(frame.scan, points=np.full((5, 3), np.nan, np.float32))
    with pytest.raises(ValueError, match="scan 0: expected points, found none"):
        live.add(frame._replace(scan=nothing))
    little = dataclasses.replace(frame.scan, points=np.ones((3, 3), np.float32))
    assert live.add(frame._replace(scan=little)) == [] and said.kinds == ["empty"]
    live.close()


def test_a_full_disk_is_reported_and_the_map_lives_on(drive, params, tmp_path, said, monkeypatch):
    live = opened(params, tmp_path, said)
    live.restore()
    with monkeypatch.context() as patch:
        patch.setattr(os, "write", lambda *given: (_ for _ in ()).throw(OSError(28, "No space left on device")))
        for i in range(2):
            assert live.add(live_frame(drive, i)) == []
    assert len(live) == 2 and said.kinds == ["disk"] and "No space left" in said[0][1]
    assert said[0][1].endswith("a restart continues before this scan")
    monkeypatch.setattr("sglpr_jax.live.live_map.sys.getsizeof", pytest.fail)  # names are counted when they come
    assert live.nbytes > 0
    live.close()


def test_a_map_whose_disk_is_full_starts_again(drive, params, tmp_path, said, monkeypatch):
    live = opened(params, tmp_path, said)
    live.restore()
    fail = OSError(28, "No space left on device")
    monkeypatch.setattr("sglpr_jax.live.live_map.append_whole", lambda *_, **__: (_ for _ in ()).throw(fail))
    live.add(live_frame(drive, 0))
    assert said.kinds == ["disk"] and said[0][1].endswith("a restart continues after this scan")
    live.close()
    before = (tmp_path / LOOPS_JSONL).stat()
    again = opened(params, tmp_path, said)
    assert again.restore() == [] and len(again) == 1
    assert (tmp_path / LOOPS_JSONL).stat().st_ino == before.st_ino  # not written
    again.close()


def test_a_removed_folder_is_reported_and_the_results_are_written(drive, params, tmp_path, said):
    live = opened(params, tmp_path / "map", said)
    live.restore()
    shutil.rmtree(tmp_path / "map")
    assert live.add(live_frame(drive, 0)) == [] and said.kinds == ["disk"] and "was removed" in said[0][1]
    assert "loops.jsonl" in {path.name for path in write_results(live, tmp_path / "map")}
    live.close()
