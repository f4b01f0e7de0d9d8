"""The folder of several recordings has one graph, rows that name the recordings, and the transforms."""

import dataclasses
import json

import numpy as np
import pytest

from sglpr_jax.data.formats.pose_files import read_tum
from sglpr_jax.data.warning import DataWarning
from sglpr_jax.loops.closure import Rejected
from sglpr_jax.pose_graph.files import read_g2o, read_loops_csv, read_loops_jsonl
from sglpr_jax.pose_graph.folder import FIRST_VERTEX, unique_names, vertices, write_found, write_several
from sglpr_jax.pose_graph.optimize import OptimizedRecordings
from sglpr_jax.se3 import inverse

from .pairs import found_pair


@pytest.fixture(scope="module")
def found():
    return found_pair()


def test_one_graph_has_both_trajectories_in_one_frame_and_all_loops(found, tmp_path):
    write_several(found, tmp_path)
    graph, loops = read_g2o(tmp_path / "loops.g2o"), found.between[0].loops
    first, second = (len(one.recording) for one in found.recordings)
    assert sorted(graph.poses) == [*range(first), *range(FIRST_VERTEX, FIRST_VERTEX + second)]
    assert len(graph.edges) == first - 1 + second - 1 + len(loops)
    for i, j, pose, _ in graph.edges[-len(loops) :]:  # the poses of the vertices are near those of the loops
        apart = inverse(inverse(graph.poses[i]) @ graph.poses[j]) @ pose
        assert i < FIRST_VERTEX <= j and np.linalg.norm(apart[:3, 3]) < 0.5
    head = (tmp_path / "loops.g2o").read_text().splitlines()[:2]
    assert head[1] == "# tuesday: vertex = 1000000 + number of the scan; poses in the frame of monday"


def test_rows_name_the_recordings_and_the_transform_is_in_frames_json(found, tmp_path):
    pair = dataclasses.replace(found.between[0], rejected=(Rejected(found.between[0].loops[0], "repeats"),))
    write_several(dataclasses.replace(found, between=(pair,)), tmp_path)
    loops = read_loops_jsonl(tmp_path / "loops.jsonl")
    assert [loop.query - FIRST_VERTEX for loop in loops] == [loop.query for loop in pair.loops]
    assert [row[:2] for row in read_loops_csv(tmp_path / "loops.csv")] == [(loop.query, loop.match) for loop in loops]
    for name in ("loops.jsonl", "rejected.jsonl"):
        row = json.loads((tmp_path / name).read_text().splitlines()[0])
        assert (row["query_recording"], row["match_recording"]) == ("tuesday", "monday")
        assert row["query_id"] == f"{row['query'] - FIRST_VERTEX:06d}"
    frames = json.loads((tmp_path / "frames.json").read_text())
    assert [one["first_vertex"] for one in frames["recordings"]] == [0, FIRST_VERTEX]
    (transform,) = frames["transforms"]
    assert transform["match_frame"]["frame"] == "odometry" and transform["loops"] == len(loops)
    np.testing.assert_allclose(transform["match_from_query"], pair.aligned[0].alignment.match_from_query)


def test_trajectories_are_those_of_each_recording_and_older_ones_are_told(found, tmp_path):
    odometry = tuple(one.odometry for one in found.recordings)
    write_several(found, tmp_path, optimized=OptimizedRecordings(odometry, ((0, 1),), ()))
    names = {path.name for path in tmp_path.iterdir() if path.suffix == ".tum"}
    assert names == {f"trajectory{kind}-{day}.tum" for kind in ("", "-optimized") for day in ("monday", "tuesday")}
    np.testing.assert_allclose(read_tum(tmp_path / "trajectory-tuesday.tum")[0], odometry[1], atol=1e-6)
    with pytest.warns(DataWarning, match=r"trajectory-tuesday.tum, frames.json are from an earlier run"):
        write_found(found.recordings[0], tmp_path)


def test_without_a_common_place_each_trajectory_stays_in_its_frame(found, tmp_path):
    none = dataclasses.replace(found.between[0], loops=(), aligned=())
    apart = dataclasses.replace(found, between=(none,))
    assert str(apart).splitlines()[-1] == "monday and tuesday: no common place found"
    write_several(apart, tmp_path)
    graph = read_g2o(tmp_path / "loops.g2o")
    np.testing.assert_allclose(graph.poses[FIRST_VERTEX], found.recordings[1].odometry[0], atol=1e-9)
    assert json.loads((tmp_path / "frames.json").read_text())["no_common_place"] == [["monday", "tuesday"]]


def test_names_and_vertices_of_recordings_do_not_collide(found):
    same = dataclasses.replace(found, recordings=(found.recordings[0],) * 3)
    assert unique_names(same) == ["monday", "monday~2", "monday~3"]
    assert [int(rows[0]) for rows in vertices(same)] == [0, FIRST_VERTEX, 2 * FIRST_VERTEX]
    last = np.arange(len(found.recordings[0].recording)) + FIRST_VERTEX
    long = dataclasses.replace(
        found.recordings[0], recording=dataclasses.replace(found.recordings[0].recording, rows=last)
    )
    assert [int(rows[0]) for rows in vertices(dataclasses.replace(found, recordings=(long, long)))] == [
        FIRST_VERTEX,
        11 * FIRST_VERTEX,
    ]
