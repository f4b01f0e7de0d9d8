"""A recording without loops says why, and each rejected pair has a reason with a meaning."""

import dataclasses
import typing
from pathlib import Path

import numpy as np
from recordings import of_images

from sglpr_jax.loops.closure import MEANING, Loop, Reason, Rejected, counted, listed, why_rejected
from sglpr_jax.loops.config import CandidateConfig
from sglpr_jax.loops.search import FoundLoops, why_none

LOOP = Loop(5, 0, np.eye(4), np.eye(6), 0.995)


def found_in(frames: int, **about) -> FoundLoops:
    """No loops in a recording of this many frames."""
    images = {Path(f"{i:06d}.png"): np.eye(8, dtype=np.float32) for i in range(frames)}
    return FoundLoops(of_images(images), frames, (), (), None, **about)


def test_a_drive_that_never_comes_back_compares_no_pair():
    (said,) = why_none(found_in(700))
    recent_m = CandidateConfig().recent_m
    assert said.startswith("No pair was compared: according to the images") and f"at least {recent_m:g} m" in said
    odometry = dataclasses.replace(found_in(700), odometry=np.tile(np.eye(4), (700, 1, 1)))
    assert "according to the odometry" in why_none(odometry)[0]


def test_empty_unreadable_and_unseen_scans_are_reasons():
    found = found_in(700)
    assert "690 of 700 scans are almost empty (fewer than 20" in why_none(dataclasses.replace(found, empty=690))[0]
    skipped = tuple(map(str, range(400)))
    assert why_none(dataclasses.replace(found, skipped=skipped))[0] == "400 of 700 scans cannot be read."
    assert why_none(dataclasses.replace(found, frames=0)) == ["The search was stopped before the first scan."]
    first, second = why_none(dataclasses.replace(found, frames=5))
    assert first == "The search was stopped after 5 of 700 frames." and second.startswith("No pair was compared")


def test_the_most_frequent_reason_is_given_and_loops_need_none():
    rejected = (Rejected(LOOP, "little overlap"), Rejected(LOOP, "repeats"), Rejected(LOOP, "repeats"))
    found = dataclasses.replace(found_in(700), rejected=rejected)
    assert why_none(found) == [f"3 pairs were compared. For 2 of them: {MEANING['repeats']}"]
    assert why_none(dataclasses.replace(found, loops=(LOOP,))) == []


def test_each_reason_has_a_meaning_and_a_count():
    assert set(MEANING) == set(typing.get_args(Reason))
    assert counted([]) == {} and listed({}) == "" and why_rejected([]) == []
    lines = why_rejected([Rejected(LOOP, reason) for reason in MEANING])
    assert lines == [f"rejected, {reason} (1): {meaning}" for reason, meaning in MEANING.items()]


def test_degenerate_loops_are_counted_and_can_be_rejected():
    unsure = dataclasses.replace(LOOP, query=3, covariance=np.diag([4.0, 0.01, 1, 1, 1, 1]))
    found = dataclasses.replace(found_in(9), loops=(unsure, dataclasses.replace(LOOP, covariance=np.eye(6) / 4)))
    assert str(found).startswith("2 loops (1 degenerate) in 9 of 9 frames")
    left = found.without_degenerate()
    assert [loop.query for loop in left.loops] == [5]
    assert [(one.loop.query, one.reason) for one in left.rejected] == [(3, "degenerate")]
    assert "1 rejected (degenerate: 1)" in str(left)
