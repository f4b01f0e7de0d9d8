"""A recording without loops says why, and each rejected pair has a reason with a meaning."""

import dataclasses
import re
import typing
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from recordings import of_images

from sglpr_jax.loops.comparison import Candidate
from sglpr_jax.loops.explanation import why_few_queries, why_none
from sglpr_jax.loops.find import FoundLoops
from sglpr_jax.loops.loop import Loop, Reason, Rejected
from sglpr_jax.loops.probability import Curve, Evidence, LoopModel
from sglpr_jax.loops.reasons import MEANING, counted, listed, why_rejected
from sglpr_jax.loops.verification import Alignment

LOOP = Loop(5, 0, np.eye(4), np.eye(6), 0.995)
MODEL = LoopModel({"correlation": Curve((-9.0, 9.0), (-9.0, 9.0))}, 0.0, "by hand")


def found_in(frames: int, times: np.ndarray | None, **about) -> FoundLoops:
    """No loops in a recording of this many frames."""
    images = {Path(f"{i:06d}.png"): np.eye(8, dtype=np.float32) for i in range(frames)}
    return FoundLoops(of_images(images, times=times), frames, (), (), None, **about)


def pairs(*correlations: float) -> tuple[Candidate, ...]:
    alignment = Alignment(*map(jnp.zeros, [(), (), (), (3, 3), (), ()]))
    return tuple(
        Candidate(50 + k, k, alignment, Evidence.of(0.0, 0.0, c, 0.0, 0.0, 1e3)) for k, c in enumerate(correlations)
    )


@pytest.mark.parametrize(
    ("frames", "times", "words"),
    [
        (40, None, "40 frames without times: pairs less than 290 frames apart are not considered; give --times."),
        (300, None, "300 frames without times: pairs less than 290 frames apart .* Only 9 of 300 frames"),
        (100, np.arange(100) / 10, "The recording lasts 9.9 s: pairs less than 30 s apart are not considered.$"),
        (400, np.arange(400) / 10, "The recording lasts 39.9 s: .* Only 100 of 400 frames"),
        (100, np.full(100, 7.5), "The times do not advance: all 100 frames have the time 7.5 s; give --times."),
        (100, np.minimum(np.arange(100.0), 20), r"lasts 20 s \(79 of 99 times do not advance\): pairs less"),
        (100, np.arange(100) / 1e4, "lasts 0.0099 s: .* Times are expected in seconds."),
    ],
)
def test_frames_that_are_too_close_in_time_are_the_reason(frames, times, words):
    (said,) = why_none(found_in(frames, times))
    assert re.search(words, said)
    found = found_in(frames, times)
    assert why_few_queries(found.recording, found.config.candidates) == said


def test_long_recordings_have_other_reasons():
    found = found_in(700, np.arange(700) / 10)
    assert why_few_queries(found.recording, found.config.candidates) is None
    assert "moved less than 10 m" in why_none(found)[0]
    odometry = dataclasses.replace(found, odometry=np.tile(np.eye(4), (700, 1, 1)))
    assert "according to the odometry, no earlier frame is near enough (within 4 sigmas" in why_none(odometry)[0]
    (said,) = why_none(dataclasses.replace(found, candidates=pairs(-3.0, -4.0), model=MODEL))
    assert said == "2 pairs were compared, and none is similar enough: the highest probability is 0.0474."
    assert why_none(dataclasses.replace(found, candidates=pairs(-3.0)))[0].endswith("none is similar enough.")
    (said,) = why_none(dataclasses.replace(found, candidates=pairs(-3.0, 6.0), model=MODEL))
    assert "too few frames before and after" in said


def test_empty_unreadable_and_unseen_scans_are_reasons():
    found = found_in(700, np.arange(700) / 10)
    assert "690 of 700 scans are almost empty (fewer than 20" in why_none(dataclasses.replace(found, empty=690))[0]
    skipped = tuple(map(str, range(400)))
    assert why_none(dataclasses.replace(found, skipped=skipped)) == ["400 of 700 scans cannot be read."]
    assert why_none(dataclasses.replace(found, frames=0)) == ["The search was stopped before the first scan."]
    first, second = why_none(dataclasses.replace(found, frames=5))
    assert first == "The search was stopped after 5 of 700 frames." and second.startswith("The recording lasts 0.4 s")


def test_pairs_that_were_all_rejected_are_a_reason_and_loops_need_none():
    rejected = (Rejected(LOOP, "little overlap"), Rejected(LOOP, "repeats"), Rejected(LOOP, "repeats"))
    found = dataclasses.replace(found_in(700, np.arange(700) / 10), rejected=rejected)
    assert why_none(found) == ["3 pairs looked like loops, and all were rejected (repeats: 2, little overlap: 1)."]
    assert why_none(dataclasses.replace(found, loops=(LOOP,))) == []


def test_each_reason_has_a_meaning_and_a_count():
    assert set(MEANING) == set(typing.get_args(Reason))
    assert counted([]) == {} and listed({}) == "" and why_rejected([]) == []
    lines = why_rejected([Rejected(LOOP, reason) for reason in MEANING])
    assert lines[0] == f"rejected, repeats (1): {MEANING['repeats']}" and len(lines) == len(MEANING)


def test_degenerate_loops_are_counted_and_can_be_rejected():
    unsure = dataclasses.replace(LOOP, query=3, covariance=np.diag([4.0, 0.01, 1, 1, 1, 1]))
    found = dataclasses.replace(found_in(9, None), loops=(unsure, dataclasses.replace(LOOP, covariance=np.eye(6) / 4)))
    assert str(found).startswith("2 loops (1 degenerate) in 9 of 9 frames")
    left = found.without_degenerate()
    assert [loop.query for loop in left.loops] == [5]
    assert [(one.loop.query, one.reason) for one in left.rejected] == [(3, "degenerate")]
    assert "1 rejected (degenerate: 1)" in str(left)
