"""The folder of what was found holds what each program reads, of the frames that were looked at."""

import dataclasses
import json

import numpy as np
import pytest
from recordings import of_images

from sglpr_jax.data.formats.pose_files import read_kitti, read_tum
from sglpr_jax.data.scan_stream import only
from sglpr_jax.data.warning import DataWarning
from sglpr_jax.files import WriteError
from sglpr_jax.loops.closure import Loop, Rejected
from sglpr_jax.loops.search import FoundLoops
from sglpr_jax.pose_graph import folder
from sglpr_jax.pose_graph.files import read_g2o, read_loops_csv, read_loops_jsonl
from sglpr_jax.pose_graph.folder import write_found
from sglpr_jax.se3 import transform


@pytest.fixture
def found(tmp_path) -> FoundLoops:
    images = {tmp_path / f"{i:06d}.png": np.eye(8, dtype=np.float32) for i in range(6)}
    odometry = np.stack([transform(float(x), 0.0, 0.1 * x) for x in range(6)])
    loop = Loop(4, 0, transform(1.0, 2.0, 0.3), np.eye(6), 0.995)
    return FoundLoops(of_images(images, times=10.0 + np.arange(6)), 5, (loop,), (), odometry)


def test_all_files_are_of_the_frames_looked_at(found, tmp_path):
    paths = write_found(found, tmp_path / "out")
    assert sorted(path.name for path in paths) == sorted(path.name for path in (tmp_path / "out").iterdir())
    graph = read_g2o(tmp_path / "out" / "loops.g2o")
    assert len(graph.poses) == 5 and [(i, j) for i, j, *_ in graph.edges] == [(0, 1), (1, 2), (2, 3), (3, 4), (0, 4)]
    poses, times = read_tum(tmp_path / "out" / "trajectory.tum")
    np.testing.assert_allclose(poses, found.odometry[:5], atol=1e-6)
    np.testing.assert_allclose(times, found.recording.times[:5])
    np.testing.assert_allclose(read_kitti(tmp_path / "out" / "trajectory.kitti"), found.odometry[:5], atol=1e-6)
    assert (
        len(read_loops_jsonl(tmp_path / "out" / "loops.jsonl")) == 1 == len(read_loops_csv(tmp_path / "out/loops.csv"))
    )


def test_other_trajectories_stay_which_is_told(found, tmp_path):
    out = tmp_path / "out"
    written = {path.name: path.read_bytes() for path in write_found(found, out, optimized=found.odometry[:5])}
    assert len(written) == 8
    with pytest.warns(
        DataWarning, match=r"out: trajectory-optimized.tum, trajectory-optimized.kitti are from an earlier run"
    ):
        assert len(write_found(found, out)) == 6
    with pytest.warns(DataWarning, match=r"out: trajectory.tum, .* are from an earlier run"):
        assert len(write_found(dataclasses.replace(found, odometry=None), out)) == 4
    for name in written.keys() - {"loops.g2o"}:
        assert (out / name).read_bytes() == written[name]


def test_rejected_pairs_have_a_file_of_their_own(found, tmp_path):
    write_found(found, tmp_path)
    assert (tmp_path / "rejected.jsonl").read_bytes() == b""
    pair = Loop(5, 1, transform(2.0, 0.0, 0.0), np.eye(6), 0.25)
    write_found(dataclasses.replace(found, rejected=(Rejected(pair, "repeats"),)), tmp_path)
    assert [loop.query for loop in read_loops_jsonl(tmp_path / "loops.jsonl")] == [4]
    (line,) = (tmp_path / "rejected.jsonl").read_text().splitlines()
    assert json.loads(line) == {
        "query": 5,
        "match": 1,
        "query_id": "000005",
        "match_id": "000001",
        "reason": "repeats",
        "probability": 0.25,
        "overlap": None,
        "match_from_query": pair.match_from_query.tolist(),
    }
    with pytest.raises(ValueError, match=r"rejected.jsonl, line 1: expected a loop as JSON"):
        read_loops_jsonl(tmp_path / "rejected.jsonl")


def test_a_file_that_cannot_be_written_is_named(found, tmp_path):
    (tmp_path / "out").write_text("a file, no folder")
    with pytest.raises(WriteError, match="out"):
        write_found(found, tmp_path / "out")


def test_a_disk_that_is_full_in_the_middle_leaves_the_files_of_the_earlier_run(found, tmp_path, monkeypatch):
    write_found(found, tmp_path, optimized=found.odometry[:5], texts={"index.html": "old"})
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}

    def full(path, *args, **options):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(folder, "write_kitti", full)
    none = dataclasses.replace(found, loops=(), odometry=2 * found.odometry)
    with pytest.raises(WriteError, match=rf"^{tmp_path}/trajectory.kitti: cannot be written: No space left on device"):
        write_found(none, tmp_path, optimized=found.odometry[:5], texts={"index.html": "new"})
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_frames_keep_the_numbers_of_the_recording(found, tmp_path):
    """Also if scans without a pose were left out before the search."""
    images = {tmp_path / f"{i:06d}.png": np.eye(8, dtype=np.float32) for i in range(80)}
    some = only(of_images(images, times=10.0 + np.arange(80)), [70, 71, 72, 75, 76, 77])
    pair = Loop(3, 1, transform(2.0, 0.0, 0.0), np.eye(6), 0.25)
    write_found(dataclasses.replace(found, recording=some, rejected=(Rejected(pair, "repeats"),)), tmp_path / "out")
    assert [(query, match) for query, match, *_ in read_loops_csv(tmp_path / "out/loops.csv")] == [(76, 70)]
    assert [(loop.query, loop.match) for loop in read_loops_jsonl(tmp_path / "out/loops.jsonl")] == [(76, 70)]
    first = json.loads((tmp_path / "out/loops.jsonl").read_text())
    assert (first["query_id"], first["match_id"]) == ("000076", "000070")
    second = json.loads((tmp_path / "out/rejected.jsonl").read_text())
    assert (second["query"], second["match"], second["query_id"]) == (75, 71, "000075")
    graph = read_g2o(tmp_path / "out/loops.g2o")
    assert list(graph.poses) == [70, 71, 72, 75, 76]
    assert [(i, j) for i, j, *_ in graph.edges] == [(70, 71), (71, 72), (72, 75), (75, 76), (70, 76)]
    assert read_tum(tmp_path / "out/trajectory.tum")[1].tolist() == [80, 81, 82, 85, 86]


def test_a_trajectory_without_times_has_row_numbers_that_are_read_as_such(found, tmp_path):
    write_found(dataclasses.replace(found, recording=dataclasses.replace(found.recording, times=None)), tmp_path)
    assert read_tum(tmp_path / "trajectory.tum")[1] is None
