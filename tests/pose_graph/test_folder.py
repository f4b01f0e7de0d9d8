"""The folder of a search holds what each program reads, for one session and for several."""

import dataclasses
import json

import numpy as np
import pytest
from recordings import of_images
from session_pairs import found_pair

from sglpr_jax.data.formats.pose_files import read_kitti, read_tum
from sglpr_jax.data.scan_stream import only
from sglpr_jax.files import DataWarning
from sglpr_jax.loops.closure import LoopClosure, RejectedClosure
from sglpr_jax.loops.frame_alignment import TrajectorySegment
from sglpr_jax.loops.result import LoopSearchResult, Session
from sglpr_jax.odometry.drift_model import DriftModel
from sglpr_jax.pose_graph.files import read_g2o, read_loops_jsonl
from sglpr_jax.pose_graph.folder import FIRST_VERTEX, vertex_numbers, write_loop_folder
from sglpr_jax.pose_graph.optimize import OptimizedTrajectory
from sglpr_jax.se3 import inverse, transform


@pytest.fixture
def found(tmp_path) -> LoopSearchResult:
    images = {tmp_path / f"{i:06d}.png": np.eye(8, dtype=np.float32) for i in range(6)}
    odometry = np.stack([transform(float(x), 0.0, 0.1 * x) for x in range(6)])
    loop = LoopClosure(4, 0, transform(1.0, 2.0, 0.3), np.eye(6), 0.995)
    return LoopSearchResult((Session(of_images(images, times=10.0 + np.arange(6)), 5, odometry),), (loop,))


@pytest.fixture(scope="module")
def pair() -> LoopSearchResult:
    return found_pair()


def corrected(found: LoopSearchResult) -> OptimizedTrajectory:
    poses = [one.odometry[: one.frames] for one in found.sessions]
    return OptimizedTrajectory(np.concatenate(poses), np.ones(len(found.loops), bool))


def table(path) -> list[tuple[int, int]]:
    """Query and match of each row of a csv table."""
    return [tuple(map(int, line.split(",")[:2])) for line in path.read_text().splitlines()[1:]]


def with_session(found: LoopSearchResult, **change) -> LoopSearchResult:
    return dataclasses.replace(found, sessions=(dataclasses.replace(found.sessions[0], **change),))


def test_all_files_are_of_the_searched_frames(found, tmp_path):
    paths = write_loop_folder(found, tmp_path / "out")
    assert sorted(path.name for path in paths) == sorted(path.name for path in (tmp_path / "out").iterdir())
    graph = read_g2o(tmp_path / "out" / "loops.g2o")
    assert len(graph.poses) == 5 and [(i, j) for i, j, *_ in graph.edges] == [(0, 1), (1, 2), (2, 3), (3, 4), (0, 4)]
    poses, times = read_tum(tmp_path / "out" / "trajectory.tum")
    np.testing.assert_allclose(poses, found.sessions[0].odometry[:5], atol=1e-6)
    np.testing.assert_allclose(times, found.sessions[0].recording.times[:5])
    np.testing.assert_allclose(
        read_kitti(tmp_path / "out" / "trajectory.kitti"), found.sessions[0].odometry[:5], atol=1e-6
    )
    assert len(read_loops_jsonl(tmp_path / "out/loops.jsonl")) == 1 == len(table(tmp_path / "out/loops.csv"))


def test_frames_keep_the_numbers_of_the_recording_and_rejected_pairs_have_a_file(found, tmp_path):
    """Also if scans without a pose were left out before the search. Without times, the numbers are the times."""
    images = {tmp_path / f"{i:06d}.png": np.eye(8, dtype=np.float32) for i in range(80)}
    some = only(of_images(images), [70, 71, 72, 75, 76, 77])
    rejected = RejectedClosure(LoopClosure(3, 1, transform(2.0, 0.0, 0.0), np.eye(6), 0.25), "repeats")
    write_loop_folder(dataclasses.replace(with_session(found, recording=some), rejected=(rejected,)), tmp_path / "out")
    assert table(tmp_path / "out/loops.csv") == [(76, 70)]
    first, second = (json.loads((tmp_path / "out" / f"{name}.jsonl").read_text()) for name in ("loops", "rejected"))
    assert (first["query"], first["query_id"], first["match_id"]) == (76, "000076", "000070")
    assert (second["query"], second["match"], second["query_id"]) == (75, 71, "000075")
    graph = read_g2o(tmp_path / "out/loops.g2o")
    assert list(graph.poses) == [70, 71, 72, 75, 76]
    assert [(i, j) for i, j, *_ in graph.edges] == [(70, 71), (71, 72), (72, 75), (75, 76), (70, 76)]


def test_one_graph_has_all_trajectories_in_one_frame_and_all_loops(pair, tmp_path):
    write_loop_folder(pair, tmp_path)
    graph = read_g2o(tmp_path / "loops.g2o")
    first, second = (len(one.recording) for one in pair.sessions)
    assert sorted(graph.poses) == [*range(first), *range(FIRST_VERTEX, FIRST_VERTEX + second)]
    assert len(graph.edges) == first - 1 + second - 1 + len(pair.loops)
    for i, j, pose, _ in graph.edges[-len(pair.loops) :]:  # the poses of the vertices are near those of the loops
        apart = inverse(inverse(graph.poses[i]) @ graph.poses[j]) @ pose
        assert i < FIRST_VERTEX <= j and np.linalg.norm(apart[:3, 3]) < 0.5
    head = (tmp_path / "loops.g2o").read_text().splitlines()[:2]
    assert head[1] == "# tuesday: vertex = 1000000 + number of the scan; poses in the frame of monday"


def test_edges_of_each_trajectory_have_the_drift_of_its_session(pair, tmp_path):
    monday, tuesday = pair.sessions
    tuesday = dataclasses.replace(tuesday, drift=DriftModel().scaled(10.0))
    write_loop_folder(dataclasses.replace(pair, sessions=(monday, tuesday)), tmp_path)
    edges = read_g2o(tmp_path / "loops.g2o").edges
    first, second = edges[0][3], edges[len(monday.recording) - 1][3]  # of steps of 2 m
    np.testing.assert_allclose(np.diag(first), 100 * np.diag(second), rtol=0.01)


def test_rows_name_the_recordings_and_the_transform_is_in_frames_json(pair, tmp_path):
    segment = TrajectorySegment(0, 100, 180, False)  # numbers of scans, not rows
    transforms = (pair.transforms[0]._replace(match=segment),)
    rejected = (RejectedClosure(pair.loops[0], "repeats"),)
    write_loop_folder(dataclasses.replace(pair, rejected=rejected, transforms=transforms), tmp_path)
    loops = read_loops_jsonl(tmp_path / "loops.jsonl")
    assert [loop.query - FIRST_VERTEX for loop in loops] == [loop.query for loop in pair.loops]
    assert table(tmp_path / "loops.csv") == [(loop.query, loop.match) for loop in loops]
    for name in ("loops.jsonl", "rejected.jsonl"):
        row = json.loads((tmp_path / name).read_text().splitlines()[0])
        assert (row["query_recording"], row["match_recording"]) == ("tuesday", "monday")
        assert row["query_id"] == f"{row['query'] - FIRST_VERTEX:06d}"
    frames = json.loads((tmp_path / "frames.json").read_text())
    assert [one["first_vertex"] for one in frames["recordings"]] == [0, FIRST_VERTEX]
    (written,) = frames["transforms"]
    assert written["match_frame"] == {"frame": "LiDAR at scan 100", "first": 100, "last": 180}
    assert written["query_frame"]["frame"] == "odometry" and written["loops"] == len(loops)
    np.testing.assert_allclose(written["match_from_query"], pair.transforms[0].match_from_query)


def test_trajectories_of_several_sessions_have_names_and_older_ones_a_warning(pair, tmp_path):
    write_loop_folder(pair, tmp_path, optimized=corrected(pair))
    names = {path.name for path in tmp_path.iterdir() if path.suffix == ".tum"}
    assert names == {f"trajectory{kind}-{day}.tum" for kind in ("", "-optimized") for day in ("monday", "tuesday")}
    for name in ("trajectory-tuesday", "trajectory-optimized-tuesday"):
        np.testing.assert_allclose(read_tum(tmp_path / f"{name}.tum")[0], pair.sessions[1].odometry, atol=1e-6)
    with pytest.warns(DataWarning, match=r"trajectory-tuesday.tum, frames.json are from an earlier run"):
        write_loop_folder(pair.within(0), tmp_path)


def test_without_a_common_place_each_trajectory_stays_in_its_frame(pair, tmp_path):
    apart = dataclasses.replace(pair, loops=(), transforms=())
    assert str(apart).splitlines()[-1] == "monday and tuesday: no common place found"
    write_loop_folder(apart, tmp_path)
    graph = read_g2o(tmp_path / "loops.g2o")
    np.testing.assert_allclose(graph.poses[FIRST_VERTEX], pair.sessions[1].odometry[0], atol=1e-9)
    assert json.loads((tmp_path / "frames.json").read_text())["no_common_place"] == [["monday", "tuesday"]]


def test_names_and_vertices_of_sessions_do_not_collide(pair):
    same = dataclasses.replace(pair, sessions=(pair.sessions[0],) * 3)
    assert same.unique_names == ["monday", "monday~2", "monday~3"]
    assert [int(rows[0]) for rows in vertex_numbers(same)] == [0, FIRST_VERTEX, 2 * FIRST_VERTEX]
    recording = pair.sessions[0].recording
    recording = dataclasses.replace(recording, rows=np.arange(len(recording)) + FIRST_VERTEX)
    long = dataclasses.replace(pair.sessions[0], recording=recording)
    found = vertex_numbers(dataclasses.replace(pair, sessions=(long, long)))
    assert [int(rows[0]) for rows in found] == [FIRST_VERTEX, 11 * FIRST_VERTEX]
