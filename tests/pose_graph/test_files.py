"""What is written is read back; g2o's numbers stand where g2o looks for them."""

import dataclasses
import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sglpr_jax.data.formats.pose_files import read_kitti, read_trajectory, read_tum
from sglpr_jax.files import DataWarning, write_text
from sglpr_jax.loops.closure import LoopClosure
from sglpr_jax.odometry.drift_model import DriftModel
from sglpr_jax.pose_graph.files import (
    loop_lines,
    read_g2o,
    read_loops_jsonl,
    write_g2o,
    write_kitti,
    write_loops_csv,
    write_tum,
)
from sglpr_jax.se3 import inverse


@pytest.fixture
def poses() -> np.ndarray:
    """In UTM: seven digits before the point."""
    rng = np.random.default_rng(0)
    found = np.tile(np.eye(4), (6, 1, 1))
    found[:, :3, :3] = Rotation.random(6, rng=rng).as_matrix()
    found[:, :3, 3] = rng.normal(scale=100, size=(6, 3)) * [1, 1, 0.1] + [412345.678912345, 5654321.123456789, 0.0]
    return found


@pytest.fixture
def loops(poses) -> list[LoopClosure]:
    rng = np.random.default_rng(1)
    spread = [a @ a.T + np.eye(6) for a in rng.normal(size=(2, 6, 6))]
    relative = [inverse(poses[m]) @ poses[q] for q, m in ((5, 0), (4, 1))]
    return [
        LoopClosure(5, 0, relative[0], spread[0], 0.99),
        LoopClosure(4, 1, relative[1], spread[1], 0.95, overlap=0.7),
    ]


def test_a_graph_comes_back_from_g2o(tmp_path, poses, loops):
    write_g2o(tmp_path / "loops.g2o", loops, [(np.arange(6), poses, DriftModel())])
    graph = read_g2o(tmp_path / "loops.g2o")
    found = np.stack([graph.poses[i] for i in range(6)])
    np.testing.assert_array_equal(found[:, :3, 3], poses[:, :3, 3])
    np.testing.assert_allclose(found, poses, rtol=0, atol=1e-9)
    assert [(i, j) for i, j, *_ in graph.edges] == [(i, i + 1) for i in range(5)] + [(0, 5), (1, 4)]
    for i, j, relative, information in graph.edges:
        np.testing.assert_allclose(poses[i] @ relative, poses[j], atol=1e-5)
        np.testing.assert_allclose(information, information.T)
        assert (np.linalg.eigvalsh(information) > 0).all()
    for loop, (_, _, _, information) in zip(loops, graph.edges[5:], strict=True):
        np.testing.assert_allclose(np.linalg.inv(information), loop.covariance, rtol=1e-5, atol=1e-6)


def test_the_numbers_of_an_edge_by_hand(tmp_path):
    pose = np.eye(4)
    pose[:3, 3] = 1, 2, 3
    write_g2o(tmp_path / "a.g2o", [LoopClosure(7, 3, pose, np.diag([1, 0.25, 0.2, 0.1, 0.05, 0.04]), 0.9)])
    (line,) = (tmp_path / "a.g2o").read_text().splitlines()
    assert line == "EDGE_SE3:QUAT 3 7 1 2 3 0 0 0 1 " + "1 0 0 0 0 0 4 0 0 0 0 5 0 0 0 10 0 0 20 0 25"


def test_edges_without_information_have_the_unit_matrix(tmp_path):
    path = tmp_path / "a.g2o"
    path.write_text("VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\nFIX 0\nEDGE_SE3:QUAT 3 7 1 2 3 0 0 0 1\n")
    with pytest.warns(DataWarning, match=r"a\.g2o: only VERTEX_SE3:QUAT and EDGE_SE3:QUAT are read.*: FIX \(1\)"):
        ((first, second, pose, information),) = read_g2o(path).edges
    assert (first, second, pose[:3, 3].tolist()) == (3, 7, [1, 2, 3])
    np.testing.assert_array_equal(information, np.eye(6))
    path.write_text("EDGE_SE3:QUAT 3 7 1 2 3 0 0 0 1" + " 1" * 21 + "\nEDGE_SE3:QUAT 3 7 1 2 3 0 0 0 1\n")
    with pytest.raises(ValueError, match=r"a\.g2o, line 2: expected 30 numbers, found 9"):
        read_g2o(path)
    path.write_text("EDGE_SE3:QUAT 3 7 1 2 3 0 0 0 1 1 0 0\n")
    with pytest.raises(ValueError, match=r"a\.g2o, line 1: expected 30 numbers, found 12"):
        read_g2o(path)


def test_loops_come_back_from_json_lines_and_csv(tmp_path, loops):
    write_text(tmp_path / "loops.jsonl", loop_lines(loops, ids=[f"frame{i}" for i in range(6)]))
    write_loops_csv(tmp_path / "loops.csv", loops)
    first = json.loads((tmp_path / "loops.jsonl").read_text().splitlines()[0])
    assert (first["query_id"], first["match_id"]) == ("frame5", "frame0")
    table = np.genfromtxt(tmp_path / "loops.csv", delimiter=",", names=True)
    for loop, again, row in zip(loops, read_loops_jsonl(tmp_path / "loops.jsonl"), table, strict=True):
        assert (again.query, again.match, again.probability, again.overlap) == (
            loop.query, loop.match, loop.probability, loop.overlap,
        )  # fmt: skip
        np.testing.assert_array_equal(again.match_from_query, loop.match_from_query)
        np.testing.assert_array_equal(again.covariance, loop.covariance)
        assert (row["query"], row["match"], row["probability"]) == (loop.query, loop.match, loop.probability)
        assert [row["x"], row["y"], row["z"]] == loop.match_from_query[:3, 3].tolist()
        np.testing.assert_array_equal(row["overlap"], np.nan if loop.overlap is None else loop.overlap)


@pytest.mark.parametrize(
    ("read", "text", "message"),
    [
        (read_g2o, "EDGE_SE3:QUAT 1 2 3\n", "line 1: expected 30 numbers, found 3"),
        (read_g2o, "FIX 0\nVERTEX_SE3:QUAT 1 2 3 4 5 6 7 x\n", "line 2: expected numbers"),
        (read_g2o, "# a comment\nFIX 0\nVERTEX_SE2 0 1 2 3\n", r"found FIX \(1\), VERTEX_SE2 \(1\)"),
        (
            read_g2o,
            "VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\nVERTEY_SE3:QUAT 1 0 0 0 0 0 0 1\n",
            "line 2: expected a type of g2o",
        ),
        (read_g2o, "V\0E\0R\0", "expected text in UTF-8"),
        (read_g2o, "EDGE_SE3:QUAT 0 1 1 2 3 0 0 0 1 -1" + " 0" * 20 + "\n", "line 1: expected a positive semidefinite"),
        (read_loops_jsonl, '{"query": 1}\n', "line 1: expected a loop as JSON"),
        (read_tum, "0 1 2 3 0 0 0 2\n", "expected a rotation qx qy qz qw of length 1 in row 1"),
        (read_tum, "1 1 2 3 0 0 0 1\n0 1 2 3 0 0 0 1\n", "row 2: expected a time >= 1"),
        (read_kitti, "1 2 3\n", "line 1: expected 12 numbers, found 3"),
    ],
)
def test_wrong_files_are_one_clear_error(tmp_path, read, text, message):
    path = tmp_path / "file"
    with pytest.raises(FileNotFoundError, match="file: "):
        read(path)
    path.write_text(text)
    with pytest.raises(ValueError, match=rf"file.*{message}"):
        read(path)


@pytest.mark.parametrize(
    "covariance",
    [-np.eye(6), np.zeros((6, 6)), np.triu(np.ones((6, 6))), np.eye(6) + 5 * np.eye(6)[::-1], np.full((6, 6), np.nan)],
    ids=["negative", "zero", "not symmetric", "indefinite", "not finite"],
)
def test_a_loop_with_an_impossible_covariance_is_refused(tmp_path, loops, covariance):
    path = tmp_path / "loops.jsonl"
    write_text(path, loop_lines([loops[0], dataclasses.replace(loops[1], covariance=covariance)]))
    with pytest.raises(ValueError, match=r"loops\.jsonl, line 2: expected a loop as JSON"):
        read_loops_jsonl(path)
    assert len(read_loops_jsonl(path, skip_damaged=True)) == 1


def test_trajectories_come_back_with_all_digits(tmp_path, poses):
    poses, times = poses.copy(), 1.7e9 + np.arange(6) / 7
    poses[:, 2, 3] /= 10  # heights as roads have them: others are warned of
    write_tum(tmp_path / "t.tum", poses, times)
    again, clock = read_tum(tmp_path / "t.tum")
    np.testing.assert_array_equal(clock, times)
    np.testing.assert_array_equal(again[:, :3, 3], poses[:, :3, 3])
    np.testing.assert_allclose(again, poses, rtol=0, atol=1e-9)
    write_kitti(tmp_path / "t.kitti", poses)
    np.testing.assert_array_equal(read_kitti(tmp_path / "t.kitti"), poses)
    np.testing.assert_array_equal(read_trajectory(tmp_path / "t.kitti", format="kitti").positions, poses[:, :3, 3])
