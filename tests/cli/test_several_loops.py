import json
import shutil

import numpy as np
import pytest
from scipy.spatial import KDTree

from sglpr_jax.cli.loops import LoopsCommand
from sglpr_jax.cli.runtime import parse_command
from sglpr_jax.data.formats.pose_files import read_tum
from sglpr_jax.data.formats.scan_files import cloud_blocks
from sglpr_jax.maps.config import CloudConfig
from sglpr_jax.pose_graph.files import write_tum
from sglpr_jax.se3 import transform

from .conftest import WALK, assert_one_line_error


@pytest.mark.slow
def test_two_recordings_of_one_drive_get_one_frame(command, walk, tmp_path):
    odometry, shifted = read_tum(walk / "poses.tum")[0][:WALK], transform(30.0, 5.0, 2.0)
    paths, files = [], []
    for name, poses in (("monday", odometry), ("tuesday", shifted @ odometry)):
        paths.append(tmp_path / name)
        paths[-1].mkdir()
        for number in range(WALK):
            shutil.copy(walk / "scans" / f"{number:06d}.bin", paths[-1])
        files.append(tmp_path / f"{name}.tum")
        write_tum(files[-1], poses, np.arange(float(WALK)))
    out = tmp_path / "found"
    maps = ("--cloud", out / "map.pcd", "--grid", out / "map.yaml")
    ended = command("loops", *paths, "--odometry", *files, "--optimize", "--no-register", "--out", out, *maps)
    assert ended.status == 0, ended.error
    assert f"{out / 'map.pcd'}: " in ended.out and f"{out / 'map.yaml'}: " in ended.out
    points = np.concatenate(list(cloud_blocks(out / "map.pcd")))
    distances_m, _ = KDTree(odometry[:, :2, 3]).query(points[:, :2])
    assert len(points) and distances_m.max() < CloudConfig().reach_m + 1  # both days are in the frame of monday
    assert "monday and tuesday: " in ended.out and "transform x " in ended.out
    (found,) = json.loads((out / "frames.json").read_text())["transforms"]
    np.testing.assert_allclose(found["match_from_query"] @ shifted, np.eye(4), atol=0.05)
    corrected = read_tum(out / "trajectory-optimized-tuesday.tum")[0]
    np.testing.assert_allclose(corrected[:, :2, 3], odometry[:, :2, 3], atol=0.5)  # the sensor has few beams
    np.testing.assert_allclose(corrected[:, 2, 3], odometry[:, 2, 3], atol=1.0)
    assert {path.name for path in out.iterdir()} >= {"loops.g2o", "index.html", "command.json"}
    assert not (out / "unfinished").exists()


def test_several_recordings_need_an_odometry_file_each(command, tmp_path):
    flags = ("a", "b", "--odometry", "a.tum", "b.tum", "--out", "found")
    parsed = parse_command(LoopsCommand, "loops", list(flags))
    assert [str(path) for path in (*parsed.recordings, *parsed.odometry_files)] == ["a", "b", "a.tum", "b.tum"]
    for more, words in (
        (("--odometry", "a.tum"), "--odometry: expected a file for each of 2 recordings, found 1"),
        (("--poses", "a.tum"), "--poses and --times are those of one recording"),
        (("--odometry", tmp_path / "trajectory-a.tum", "b.tum"), "trajectory-a.tum: expected inputs that this run"),
    ):
        assert_one_line_error(command("loops", "a", "b", "--out", tmp_path, *more), words)
