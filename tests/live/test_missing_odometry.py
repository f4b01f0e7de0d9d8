"""While odometry is missing, the scans show the motion. The odometry goes on if it agrees with them."""

import numpy as np
import pytest

from sglpr_jax.live.live_map import LiveMap
from sglpr_jax.loops.candidates import CandidateSearch, agree
from sglpr_jax.loops.detector import LoopDetector
from sglpr_jax.se3 import inverse, transform
from tests.live.conftest import BEGIN, SCANS, live_frame

MISSING = range(24, 34)
"""Scans without odometry, of the way back."""
AROUND = range(20, 37)
"""Some scans before and after them."""


@pytest.fixture
def run(drive, params, tmp_path, said):
    """A function that adds scans, with odometry that has moved after the gap. Returns map, scans and edges."""

    def opened() -> LiveMap:
        live = LiveMap(LoopDetector(params), tmp_path, report=said, expects_odometry=True)
        live.restore()
        return live

    def add(ahead_m: float = 0.0, *, scans: range = range(SCANS), restarts_at: int = SCANS):
        live = opened()
        poses, taken, edges = drive.poses.world_from_lidar.copy(), [], []
        poses[MISSING[-1] + 1 :] = transform(ahead_m, 0.0, 0.0) @ poses[MISSING[-1] + 1 :]
        for i in scans:
            if i == restarts_at:
                live.close()
                live = opened()
            found = live.add(live_frame(drive, i, pose=None if i in MISSING else poses[i]))
            if found is not None:
                taken.append(i)
                edges += found
        live.close()
        return live, taken, edges

    return add


@pytest.mark.slow
def test_the_scans_show_the_motion_while_odometry_is_missing(drive, run, said):
    live, taken, edges = run()
    poses = drive.poses.world_from_lidar
    assert taken == list(range(SCANS)) and not live.detector.finder.motion.segments.any()
    assert np.linalg.norm((live.odometry - poses)[:, :2, 3], axis=1).max() < 0.5
    assert said.kinds == ["missing"] * len(MISSING)
    assert sum(edge.query in MISSING for edge in edges) >= 3 and any(edge.query > MISSING[-1] for edge in edges)
    for edge in edges:
        error = inverse(edge.match_from_query) @ inverse(poses[edge.match]) @ poses[edge.query]
        assert np.linalg.norm(error[:2, 3]) < 1


@pytest.mark.slow
def test_odometry_that_contradicts_the_scans_after_a_pause_begins_anew(run, said):
    live, _, _ = run(ahead_m=2.0, scans=AROUND)
    assert live.detector.finder.motion.segments.tolist() == [i > MISSING[-1] for i in AROUND]
    assert said.kinds == [*["missing"] * len(MISSING), "jump"]


@pytest.mark.slow
def test_odometry_that_comes_back_after_a_restart_is_compared_with_the_scans(run, said):
    live, _, _ = run(ahead_m=2.0, scans=AROUND, restarts_at=MISSING[-1] + 1)
    assert live.detector.finder.motion.segments.tolist() == [i > MISSING[-1] for i in AROUND]
    assert said.kinds[-1] == "jump"


@pytest.mark.slow
def test_scans_that_show_no_motion_are_left_out_or_at_an_unknown_place(drive, params, tmp_path, said, monkeypatch):
    monkeypatch.setattr(CandidateSearch, "pose_by_image", lambda *_, **__: None)
    live = LiveMap(LoopDetector(params), tmp_path, report=said, expects_odometry=True)
    live.restore()
    added = []
    for i, has_pose in enumerate([True, True, False, True, False, False, False, True]):
        pose = drive.poses.world_from_lidar[i] if has_pose else None
        added.append(live.add(live_frame(drive, i, pose=pose, time=BEGIN + i)) is not None)
    live.close()
    assert added == [True, True, False, True, False, True, True, True]
    assert live.detector.finder.motion.segments.tolist() == [0, 0, 0, 1, 2, 3]
    unknown = ["missing", "unknown"]
    assert said.kinds == ["missing", "hold", "missing", "hold", *unknown, *unknown, "jump"]


@pytest.mark.parametrize(
    ("x", "z", "degrees", "expected"), [(0.7, 9.0, 5, True), (0.9, 0.0, 0, False), (0.0, 0.0, 7, False)]
)
def test_poses_agree_in_the_level_plane_whatever_the_tilt_of_the_sensor(x, z, degrees, expected):
    on_its_side = np.eye(4)
    on_its_side[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    pose, other = (
        transform(3.0, 4.0, 0.0) @ on_its_side,
        transform(3 + x, 4.0, float(np.radians(degrees))) @ on_its_side,
    )
    other[2, 3] += z
    assert agree(pose, other) == expected
