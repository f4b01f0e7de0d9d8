"""The page of several sessions shows the transforms, the pairs between sessions, and each session."""

import dataclasses

import numpy as np
import pytest

from sglpr_jax.evaluation.page.of_recordings import recordings_page
from sglpr_jax.loops.closure import Loop
from sglpr_jax.loops.frame_alignment import AlignedParts, FrameAlignment, Part
from sglpr_jax.loops.search import FoundLoops
from sglpr_jax.pose_graph.optimize import OptimizedTrajectory
from sglpr_jax.se3 import transform

from .test_loops_page import found as one_found  # noqa: F401
from .test_page import Parsed


@pytest.fixture
def found(one_found) -> FoundLoops:  # noqa: F811
    loop = Loop(2, 3, transform(1.0, 2.0, 0.3), np.eye(6), 0.995, query_session=1)
    second = (dataclasses.replace(one, query_session=1, match_session=1) for one in one_found.loops)
    alignment = FrameAlignment(transform(10.0, 0.0, 0.5), 0.01 * np.eye(6))
    transforms = (AlignedParts(Part(0, 0, 7, True), Part(1, 0, 7, True), alignment, 1),)
    return FoundLoops(2 * one_found.sessions, (*one_found.loops, *second, loop), transforms=transforms)


@pytest.mark.slow
def test_transforms_pairs_and_sessions_are_shown(found):
    page = Parsed(recordings_page(found))
    assert "28.65" in page.texts["Transforms"] and "10.00" in page.texts["Transforms"]
    assert {"Together", "08 and 08~2", "08: Trajectory", "08~2: Rejected"} <= set(page.texts)
    assert "in the frame of 08" in page.texts["Together"]
    poses = np.concatenate([one.odometry for one in found.sessions])
    corrected = OptimizedTrajectory(poses, np.ones(len(found.loops), bool))
    assert "corrected by 7 of 7 loops" in Parsed(recordings_page(found, optimized=corrected)).texts["Together"]


@pytest.mark.slow
def test_no_common_place_is_said(found):
    page = Parsed(recordings_page(dataclasses.replace(found, loops=found.loops[:-1], transforms=())))
    assert "no common place found" in page.texts["Transforms"] and "Together" not in page.texts
