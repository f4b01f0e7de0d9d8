"""A map that is continued by another process is that of one process, whatever the odometry does meanwhile."""

import dataclasses
import os

import numpy as np
import pytest

from sglpr_jax.data.formats.pose_files import read_tum
from sglpr_jax.live.corrected import CorrectedTrajectory
from sglpr_jax.live.live_map import JOURNAL, LOOPS, LiveMap
from sglpr_jax.live.results import write_results
from sglpr_jax.loops.config import DetectorConfig
from sglpr_jax.loops.detector import LoopDetector
from sglpr_jax.pose_graph.files import read_loops_jsonl
from sglpr_jax.se3 import inverse
from tests.live.conftest import SCANS, live_frame

CONFIG = DetectorConfig(min_probability=0.5)
HALF = 70


def opened(params, folder, said, **more) -> LiveMap:
    return LiveMap(LoopDetector(params, config=CONFIG), folder, report=said, **more)


@pytest.fixture(scope="module")
def whole(drive, params, tmp_path_factory):
    """Folder and edges of a map of the drive with odometry, made by one process."""
    folder = tmp_path_factory.mktemp("whole")
    live = opened(params, folder, lambda kind, text: None)
    assert live.recall() == []
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
    found = read_loops_jsonl(folder / LOOPS)
    assert [(loop.query, loop.match) for loop in found] == [(edge.query, edge.match) for edge in edges]


@pytest.mark.slow
def test_a_map_is_recalled_and_its_unfinished_end_removed(params, whole, tmp_path, said):
    folder, edges = whole
    content, lines = (folder / JOURNAL).read_bytes(), (folder / LOOPS).read_bytes()
    (tmp_path / JOURNAL).write_bytes(content[:-5])
    kept = len(edges) - 4
    (tmp_path / LOOPS).write_bytes(b"".join(lines.splitlines(True)[:kept]) + lines[:9])  # the next line is cut
    live = opened(params, tmp_path, said)
    missed = live.recall()
    assert len(live) == SCANS - 1 and said.kinds == ["cut", "recall", "log"]
    known = [(edge.query, edge.match) for edge in edges]
    found = [(loop.query, loop.match) for loop in live.detector.loops]
    assert kept < len(found) <= len(edges) and found == known[: len(found)]
    assert [(edge.query, edge.match) for edge in missed] == found[kept:]
    assert [(loop.query, loop.match) for loop in read_loops_jsonl(tmp_path / LOOPS)] == found
    assert live.names == {f"scan {i}" for i in range(SCANS - 1)}
    live.close()
    assert (tmp_path / JOURNAL).stat().st_size < len(content) - 5


@pytest.mark.slow
def test_loops_to_scans_before_a_restart_are_found_though_the_odometry_began_again(drive, params, tmp_path, said):
    poses = drive.poses.world_from_lidar
    live = opened(params, tmp_path, said)
    for i in range(HALF):
        assert live.add(live_frame(drive, i, pose=poses[i])) is not None
    del live  # as if it was killed: nothing is closed
    live = opened(params, tmp_path, said)
    assert live.recall() == [] and len(live) == HALF
    edges, again = [], inverse(poses[HALF]) @ poses[HALF:]
    corrected = CorrectedTrajectory(live)
    assert corrected.map_from_world is None
    for i, pose in enumerate(again, HALF):
        edges += live.add(live_frame(drive, i, pose=pose, received=float(drive.times[i]) + 1e9))
        corrected.update()
    assert ("restart", "the odometry is taken as unknown, and begins in a frame of its own after the restart") in said
    across = [edge for edge in edges if edge.match < HALF]
    assert len(across) > 3
    for edge in across:
        assert np.linalg.norm(drive.positions[edge.query] - drive.positions[edge.match]) < 12
        assert edge.world_from_match is None and np.array_equal(edge.world_from_query, again[edge.query - HALF])
    apart = np.linalg.norm(corrected.poses[:, :3, 3] - poses[:, :3, 3], axis=1)
    assert apart[:HALF].max() < 1 and apart[HALF:].max() < 5
    np.testing.assert_allclose(corrected.map_from_world @ again[-1], corrected.poses[-1], atol=1e-9)
    paths = {path.name for path in write_results(live, tmp_path, corrected=corrected)}
    tables = {"loops.g2o", "loops.csv", "rejected.jsonl"}
    assert paths == {*tables, "trajectory.tum", "trajectory-optimized.tum"}
    assert len(read_tum(tmp_path / "trajectory-optimized.tum")[0]) == len(live)
    steps = [line.split()[1:3] for line in (tmp_path / "loops.g2o").read_text().splitlines() if line.startswith("EDGE")]
    ends = [[str(frame) for frame in sorted((edge.query, edge.match))] for edge in edges]
    odometry = [step for step in steps if sorted(step, key=int) not in ends]
    assert [str(HALF - 1), str(HALF)] not in odometry and [str(HALF), str(HALF + 1)] in odometry
    live.close()


def test_a_map_of_other_settings_is_not_continued(params, tmp_path, said):
    opened(params, tmp_path, said).close()
    with pytest.raises(ValueError, match=r"journal.bin: .*same settings, found another sensor_height; use the flags"):
        opened(params, tmp_path, said, sensor_height=2.0)


def test_scans_of_nothing_are_left_out_or_hold_no_place(drive, params, tmp_path, said):
    live = opened(params, tmp_path, said)
    frame = live_frame(drive, 0)
    nothing = dataclasses.replace(frame.record, points=np.full((5, 3), np.nan, np.float32))
    with pytest.raises(ValueError, match="scan 0: expected points, found none"):
        live.add(frame._replace(record=nothing))
    little = dataclasses.replace(frame.record, points=np.ones((3, 3), np.float32))
    assert live.add(frame._replace(record=little)) == [] and said.kinds == ["empty"]
    live.close()


def test_a_full_disk_is_reported_and_the_map_lives_on(drive, params, tmp_path, said, monkeypatch):
    live = opened(params, tmp_path, said)
    live.recall()
    monkeypatch.setattr(os, "pwrite", lambda *given: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    for i in range(2):
        assert live.add(live_frame(drive, i)) == []
    assert len(live) == 2 and said.kinds == ["disk"] and "No space left" in said[0][1]
    live.close()
