"""bin/embed and bin/evaluate accept poses at other times or of more scans, as bin/loops and bin/map do."""

import json
import shutil

import numpy as np
import pytest

import sglpr_jax
from sglpr_jax.data.readers import open_recording
from sglpr_jax.pose_graph.files import write_tum

from .conftest import assert_one_line_error

load = sglpr_jax.DescriptorFile.load
METHOD = ("--method", "polar-fft")
PROTOCOL = ("--protocol", "top1-f1max")


@pytest.fixture
def scans(town, tmp_path):
    """The scans of 08 as a plain folder without times, and where and when they were taken."""
    shutil.copytree(town / "sequences" / "08" / "velodyne", tmp_path / "scans")
    recording = open_recording(town, "08")
    return tmp_path / "scans", recording.positions, recording.times


def write(path, positions, times):
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    poses[:, :3, 3] = positions
    write_tum(path, poses, times)
    return path


def between(positions, times, *, step=0.03):
    """Poses and times far more often than the scans."""
    stamps = np.arange(times[0], times[-1] + step, step)
    return np.stack([np.interp(stamps, times, axis) for axis in positions.T], axis=1), stamps


@pytest.mark.slow
def test_poses_of_other_times_serve_embedding_and_scoring_alike(command, scans, tmp_path):
    folder, positions, times = scans
    poses = write(tmp_path / "odometry.tum", *between(positions, times))
    np.savetxt(tmp_path / "times.txt", times)
    given = ("--data", folder, "--times", tmp_path / "times.txt", *METHOD)
    ended = command("embed", *given, "--poses", poses, "--out", tmp_path / "placed.npz")
    assert ended.status == 0, ended.error
    placed = load(tmp_path / "placed.npz")
    np.testing.assert_allclose(placed.positions, positions, atol=0.3)
    assert "odometry.tum (TUM), interpolated at the times of the scans" in placed.pose_source
    assert placed.pose_source in ended.error

    assert command("embed", *given, "--out", tmp_path / "bare.npz").status == 0
    ended = command("evaluate", tmp_path / "bare.npz", "--poses", poses, *PROTOCOL)
    assert ended.status == 0, ended.error
    report = json.loads((tmp_path / "bare" / "results.json").read_text())["results"][0]
    same = sglpr_jax.evaluate(placed, PROTOCOL[1:]).results[0]
    assert (report["score"], report["counts"]) == (same.score, same.counts) and report["poses"] == same.pose_source
    late = write(tmp_path / "late.tum", positions, 1.1 * times + 1e6)
    for run in (("embed", *given, "--out", tmp_path / "late.npz"), ("evaluate", tmp_path / "bare.npz")):
        assert_one_line_error(
            command(*run, "--poses", late), "late.tum", "expected 40 poses, one for each", "found 40 from"
        )
