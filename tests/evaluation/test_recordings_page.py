"""The page of several recordings shows the transforms, the pairs between recordings, and each recording."""

import dataclasses

import numpy as np
import pytest

from sglpr_jax.evaluation.page.of_recordings import recordings_page
from sglpr_jax.loops.closure import Loop
from sglpr_jax.loops.frame_alignment import FrameAlignment
from sglpr_jax.loops.search_between import AlignedParts, FoundBetween, FoundRecordings, Part
from sglpr_jax.pose_graph.optimize import OptimizedRecordings, OptimizedTrajectory
from sglpr_jax.se3 import transform

from .test_loops_page import found as one_found  # noqa: F401
from .test_page import Parsed


@pytest.fixture
def found(one_found) -> FoundRecordings:  # noqa: F811
    part, loop = Part(0, 7, True), Loop(2, 3, transform(1.0, 2.0, 0.3), np.eye(6), 0.995)
    alignment = FrameAlignment(transform(10.0, 0.0, 0.5), 0.01 * np.eye(6))
    pair = FoundBetween(0, 1, (loop,), (), (AlignedParts(part, part, alignment, 1),), 8)
    return FoundRecordings((one_found, one_found), (pair,))


@pytest.mark.slow
def test_transforms_pairs_and_recordings_are_shown(found):
    page = Parsed(recordings_page(found))
    assert "28.65" in page.texts["Transforms"] and "10.00" in page.texts["Transforms"]
    assert {"Together", "08 and 08~2", "08: Trajectory", "08~2: Rejected"} <= set(page.texts)
    assert "in the frame of 08" in page.texts["Together"]
    poses = tuple(one.odometry for one in found.recordings)
    said = OptimizedTrajectory(np.zeros((0, 4, 4)), np.ones(1, bool))
    corrected = Parsed(recordings_page(found, optimized=OptimizedRecordings(poses, ((0, 1),), (said,))))
    assert "corrected by 1 of 1 loops" in corrected.texts["Together"]


@pytest.mark.slow
def test_no_common_place_is_said(found):
    none = dataclasses.replace(found.between[0], loops=(), aligned=())
    page = Parsed(recordings_page(dataclasses.replace(found, between=(none,))))
    assert "no common place found" in page.texts["Transforms"] and "Together" not in page.texts
