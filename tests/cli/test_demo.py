import sys

import pytest

from sglpr_jax.odometry import kiss_icp

from .conftest import assert_one_line_error


@pytest.mark.slow
def test_the_demo_makes_a_trajectory_a_map_and_a_page_of_scans(command, tmp_path):
    out = tmp_path / "demo"
    ended = command("demo", "--out", out, "--scans", 24, "--no-open")
    assert ended.status == 0, ended.error
    assert "in 24 of 24 frames of 00" in ended.out and "position error of 00: " in ended.out
    assert ended.out.splitlines()[-1] == f"page: {out / 'found' / 'index.html'}"
    made = {path.name for path in (out / "found").iterdir()}
    assert made >= {"trajectory-optimized.tum", "map.ply", "map.pgm", "map.yaml", "drive.rrd", "index.html"}
    assert ended.error.splitlines()[-1] == (
        "With your own scans: bin/loops my_scans --odometry auto --optimize --cloud map.ply --grid map.yaml"
    )


def test_a_missing_package_is_reported_before_the_simulation(command, tmp_path, monkeypatch):
    """The drive in 3D is left out where Rerun is missing."""

    def missing():
        raise ImportError("odometry from scans needs kiss-icp")

    monkeypatch.setattr(kiss_icp, "check_installed", missing)
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert_one_line_error(command("demo", "--out", tmp_path / "demo"), "needs kiss-icp")
    assert not (tmp_path / "demo").exists()
