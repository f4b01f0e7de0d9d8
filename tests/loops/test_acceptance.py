"""Odometry rejects wrong loops of places that repeat, and keeps true ones whatever it drifts within the model."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
from drives import along, drifted, rooms, town, true_loops, wrong_loops
from recordings import of_scans

from sglpr_jax.files import DataWarning
from sglpr_jax.loops import acceptance
from sglpr_jax.loops.acceptance import accept_loops, check_odometry, count_revisit_segments
from sglpr_jax.loops.closure import LoopClosure
from sglpr_jax.loops.odometry_deviation import deviations
from sglpr_jax.odometry.drift_model import DriftModel
from sglpr_jax.odometry.path import DrivenPath
from sglpr_jax.pose_graph.optimize import solve_pose_graph
from sglpr_jax.registration.gicp import Registration
from sglpr_jax.se3 import transform, travelled

SERPENTINE = along([(0, 0), (150, 0), (150, 26), (0, 26), (0, 52), (150, 52), (150, 78), (0, 78)], 2.0)


def of_rooms() -> tuple[np.ndarray, list[LoopClosure]]:
    """Exact odometry of two rooms, and loops that take one for the other."""
    poses = rooms()
    return poses, wrong_loops(poses, (-8, 0), range(len(poses) - 60, len(poses) - 1))


def of_a_car_park() -> tuple[np.ndarray, list[LoopClosure]]:
    """Odometry 1 % too long of a car park, and loops that take each row for the one before."""
    queries = [i for i, pose in enumerate(SERPENTINE) if pose[1, 3] > 25 and i % 5 == 0]
    return drifted(SERPENTINE, percent=1, deg_per_100m=0), wrong_loops(SERPENTINE, (0, -26), queries)


@pytest.mark.parametrize("scene", [of_rooms, of_a_car_park])
def test_of_places_that_repeat_no_loop_is_accepted_and_the_odometry_stays(scene):
    odometry, wrong = scene()
    assert len(wrong) >= 50 and deviations(wrong, DrivenPath(odometry)).min() > 8
    kept, rejected = accept_loops(wrong, DrivenPath(odometry))
    assert not kept and {one.reason for one in rejected} == {"contradicts the odometry"}
    found = solve_pose_graph({0: odometry}, wrong)
    np.testing.assert_array_equal(found.poses, odometry)
    assert not found.inliers.any() and str(found).startswith(f"trajectory not corrected: {len(wrong)} loops need")


def test_true_loops_are_kept():
    true = town()
    odometry = drifted(true, percent=1, deg_per_100m=0.5, noise=1.0)
    loops = true_loops(true, every=6)
    assert len(loops) >= 52 and deviations(loops, DrivenPath(odometry)).max() < 1.7
    kept, rejected = accept_loops(loops, DrivenPath(odometry))
    assert kept == loops and not rejected


def test_a_loop_within_the_drift_that_contradicts_the_others_is_rejected():
    true = town()
    loops = true_loops(true, every=6)
    wrong = dataclasses.replace(loops[-5], match_from_query=loops[-5].match_from_query @ transform(6.0, 0.0, 0.0))
    odometry = drifted(true, percent=1, deg_per_100m=0.5)
    kept, rejected = accept_loops([*loops, wrong], DrivenPath(odometry))
    assert kept == loops and [(one.loop, one.reason) for one in rejected] == [(wrong, "contradicts other loops")]


@pytest.mark.slow
def test_odometry_that_drifts_more_than_stated_is_told_with_both_readings_and_can_be_stated():
    true = town()
    odometry, loops = drifted(true, percent=10, deg_per_100m=5), true_loops(true, every=3)
    kept, rejected = accept_loops(loops, DrivenPath(odometry))
    assert not kept
    with pytest.warns(DataWarning, match="Either places repeat, or the odometry drifts by about") as told:
        check_odometry("08", kept, [one.loop for one in rejected], DrivenPath(odometry), DriftModel(), 1)
    message = str(told[0].message)
    assert (
        "the odometry contradicts the loops of 106 of 106 frames" in message
        and "106 of 106 loops would then be consistent" in message
    )
    percent, degrees = map(
        float,
        re.search(r"--drift-percent (\S+) --drift-deg-per-100m (\S+)\.$", message.split(" Check also")[0]).groups(),
    )
    assert 5 < percent < 20 and 2 < degrees < 10
    drift = DriftModel(percent / 100, degrees / 100)
    kept, _ = accept_loops(loops, DrivenPath(odometry), drift=drift)
    assert len(kept) > 0.98 * len(loops)


def test_a_few_wrong_loops_among_many_true_ones_are_no_reason_to_doubt_the_odometry():
    true = town()
    loops = true_loops(true, every=6)
    wrong = [LoopClosure(300 + i, 100 + i, np.eye(4), loops[0].covariance, 1.0) for i in range(20)]
    kept, rejected = accept_loops([*wrong, *loops], DrivenPath(true))
    assert kept == loops and len(rejected) == 20
    against = [one.loop for one in rejected]
    check_odometry("08", kept, against, DrivenPath(true), DriftModel(), 1)  # a warning is an error


def test_loops_in_a_row_are_one_part_of_the_drive():
    poses = along([(0, 0), (600, 0)])
    at = [*range(300, 320), *range(400, 402), *range(500, 510)]
    loops = [LoopClosure(query, query - 300, np.eye(4), np.eye(6), 1.0) for query in at]
    assert count_revisit_segments(loops, travelled(poses)) == 2 and count_revisit_segments([], travelled(poses)) == 0
    same_match = [LoopClosure(query, 100 + i, np.eye(4), np.eye(6), 1.0) for i, query in enumerate(at)]
    assert count_revisit_segments(same_match, travelled(poses)) == 1


@pytest.mark.parametrize(
    ("overlap", "off_m", "kept"), [(0.7, 5.0, True), (0.45, 0.1, True), (0.45, 5.0, False), (0.2, 0.1, False)]
)
def test_scans_that_overlap_little_are_a_loop_if_both_poses_agree(monkeypatch, overlap, off_m, kept):
    def registered(query, match, *, initial, initial_covariance):
        return Registration(initial @ transform(off_m, 0.0, 0.0), 1e-4 * np.eye(6), overlap)

    monkeypatch.setattr(acceptance, "register", registered)
    recording = of_scans({Path(f"{i}.bin"): np.zeros((1, 3), np.float32) for i in range(2)})
    loop = LoopClosure(1, 0, np.eye(4), 0.01 * np.eye(6), 0.99)
    loops, rejected = acceptance.register_loops(recording, recording, [loop], should_stop=lambda: False)
    (found,) = loops if kept else [one.loop for one in rejected]
    assert found.overlap == overlap and found.match_from_query[0, 3] == off_m
    assert [one.reason for one in rejected] == ([] if kept else ["little overlap"])
