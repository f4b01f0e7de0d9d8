"""The page of loops of one or several recordings: its sections, tables and pictures."""

import dataclasses

import numpy as np
import pytest

from sglpr_jax.evaluation.loops_page import loops_page
from sglpr_jax.loops.closure import LoopClosure, RejectedClosure
from sglpr_jax.loops.comparison import Candidate
from sglpr_jax.loops.frame_alignment import SegmentAlignment, TrajectorySegment
from sglpr_jax.loops.probability import AdditiveModel, Curve, Evidence, LoopModel
from sglpr_jax.loops.result import LoopSearchResult
from sglpr_jax.pose_graph.optimize import OptimizedTrajectory
from sglpr_jax.se3 import transform

from .test_evaluation_page import Parsed


@pytest.fixture
def found(found_loops) -> LoopSearchResult:
    return found_loops


def with_session(found: LoopSearchResult, **change) -> LoopSearchResult:
    return dataclasses.replace(found, sessions=(dataclasses.replace(found.sessions[0], **change),))


def test_the_page_has_trajectory_pairs_and_least_probable_loops(found, tmp_path):
    page = Parsed(loops_page(found))
    assert [headline for headline, _ in page.images] == ["Trajectory", "Loops", "Pairs"]
    assert all(address.startswith("data:") for address in page.addresses)
    table = page.texts["Loops"]
    assert "0.9950" in table and "000005" in table and "17.2" in table


def test_the_page_says_if_odometry_loops_or_frames_are_missing(found):
    assert len(Parsed(loops_page(with_session(found, odometry=None))).images) == 2
    none = dataclasses.replace(found, loops=())
    assert loops_page(none).count("No loops.") == 2 and not Parsed(loops_page(none)).images[1:]
    assert "No pair was possible: according to the" in Parsed(loops_page(none)).texts["Why no loops"]
    assert "Why no loops" not in Parsed(loops_page(found)).texts
    page = loops_page(
        with_session(none, frames=0), optimized=OptimizedTrajectory(np.zeros((0, 4, 4)), np.zeros(0, bool))
    )
    assert "No scan was processed." in page and "orrected" not in page


def test_rejected_pairs_are_counted_by_reason(found):
    assert "No pair was rejected." in Parsed(loops_page(found)).texts["Rejected"]
    pair = found.loops[0]
    rejected = (
        RejectedClosure(pair, "little overlap"),
        RejectedClosure(pair, "repeats"),
        RejectedClosure(pair, "repeats"),
    )
    page = Parsed(loops_page(dataclasses.replace(found, rejected=rejected)))
    said = page.texts["Rejected"]
    assert said.index("repeats") < said.index("little overlap") and "Another place, or another pose" in said
    assert "Rejected pairs are grey." in page.texts["Loops"]


def test_wrong_loops_are_counted_and_come_first(known):
    page = Parsed(loops_page(known))
    assert "1 of 3 loops are wrong (red): more than 20 m apart by poses.txt." in page.texts["Trajectory"]
    table = page.texts["Loops"]
    assert "true distance [m]" in table and "94.0" in table
    assert table.index("000007") < table.index("000005") < table.index("000006")


@pytest.fixture
def known(found) -> LoopSearchResult:
    """Return the result with true positions and candidates: two are loops, one is not. The odometry has an error."""
    model = LoopModel(AdditiveModel({"surprise": Curve((-9.0, 9.0), (-9.0, 9.0))}, 0.0), "by hand")
    positions = np.zeros((8, 3))
    positions[:, 0] = [0, 1, 2, 3, 4, 5, 6, 97]
    recording = dataclasses.replace(found.sessions[0].recording, positions=positions, pose_source="poses.txt")
    pairs = [(5, 1, 6.0), (6, 2, 7.0), (7, 3, -6.0)]
    candidates = tuple(Candidate(q, m, None, Evidence.of(0.0, 0.0, 0.0, c)) for q, m, c in pairs)
    return with_session(dataclasses.replace(found, model=model), recording=recording, candidates=candidates)


def test_the_share_of_loops_is_drawn_if_positions_are_known(known):
    page = Parsed(loops_page(known))
    assert [headline for headline, _ in page.images] == ["Trajectory", "Loops", "Pairs", "Reliability"]
    said = page.texts["Reliability"]
    assert "0.99 to 1" in said and "1.000" in said and "0 to 0.01" in said and "by poses.txt" in said
    assert "No pair was compared." in loops_page(with_session(known, candidates=()))


def test_the_trajectory_before_and_after_is_drawn_with_its_error(found, known):
    optimized = OptimizedTrajectory(known.sessions[0].odometry + 0.0, np.array([True, True, False]))
    optimized.poses[:, :3, 3] = known.sessions[0].recording.positions
    page = Parsed(loops_page(known, optimized=optimized))
    assert [headline for headline, _ in page.images].count("Trajectory") == 1
    said = page.texts["Trajectory"]
    assert "Trajectory corrected by 2 of 3 loops: moved by 0.00 m at most" in said
    assert "m before the correction, 0.00 m after it" in said
    assert "RMSE" not in Parsed(loops_page(found, optimized=optimized)).texts["Trajectory"]
    assert "0.99 to 1" in page.texts["Reliability"] and "0.9950" in page.texts["Loops"]


@pytest.fixture
def several(found) -> LoopSearchResult:
    loop = LoopClosure(2, 3, transform(1.0, 2.0, 0.3), np.eye(6), 0.995, query_session=1)
    second = (dataclasses.replace(one, query_session=1, match_session=1) for one in found.loops)
    alignment = transform(10.0, 0.0, 0.5), 0.01 * np.eye(6)
    transforms = (SegmentAlignment(TrajectorySegment(0, 0, 7, True), TrajectorySegment(1, 0, 7, True), *alignment, 1),)
    return LoopSearchResult(2 * found.sessions, (*found.loops, *second, loop), transforms=transforms)


def test_transforms_pairs_and_recordings_are_shown(several):
    page = Parsed(loops_page(several))
    assert "28.65" in page.texts["Transforms"] and "10.00" in page.texts["Transforms"]
    assert {"Together", "08 and 08~2", "08: Trajectory", "08~2: Rejected"} <= set(page.texts)
    assert "in the frame of 08" in page.texts["Together"]
    poses = np.concatenate([one.odometry for one in several.sessions])
    corrected = OptimizedTrajectory(poses, np.ones(len(several.loops), bool))
    assert "corrected by 7 of 7 loops" in Parsed(loops_page(several, optimized=corrected)).texts["Together"]
    page = Parsed(loops_page(dataclasses.replace(several, loops=several.loops[:-1], transforms=())))
    assert "no common place found" in page.texts["Transforms"] and "Together" not in page.texts
