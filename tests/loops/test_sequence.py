"""Neighbours support a loop if they are consistent with it, and oppose it otherwise, by travelled distance."""

import numpy as np
import pytest

from sglpr_jax.loops import sequence
from sglpr_jax.loops.closure import LoopClosure
from sglpr_jax.loops.config import INDEPENDENT_M
from sglpr_jax.loops.probability import AdditiveModel, Curve, Evidence, LoopModel
from sglpr_jax.loops.sequence import WINDOW_M, Pair, neighbour_weights, rejection_reason
from sglpr_jax.odometry.drift_model import DriftModel
from sglpr_jax.odometry.path import DrivenPath
from sglpr_jax.se3 import inverse, transform

REPEATS = Curve((0.5, 1.0), (8.0, 0.0))
SURPRISE = Curve((0.0, 9.0), (0.0, 9.0))
MODEL = LoopModel(AdditiveModel({"ambiguity_ratio": REPEATS, "surprise": SURPRISE}, -6.0), "by hand")


def by_hand(way_m: np.ndarray, row: int) -> list[float]:
    """`neighbour_weights` of one pair, neighbour by neighbour."""
    found = []
    for other in range(len(way_m)):
        towards = way_m[other + 1] if other < row else way_m[other - 1]
        near = other != row and abs(way_m[other] - way_m[row]) <= WINDOW_M
        found.append(near * (1 - np.exp(-abs(way_m[other] - towards) / INDEPENDENT_M)))
    return found


WAY_M = np.sort(np.random.default_rng(0).uniform(0, 120, 30))


def test_a_neighbour_weighs_as_much_as_the_sensor_moved_on_the_way_to_it():
    rows = np.arange(5, 25)
    expected = [by_hand(WAY_M, row) for row in rows]
    np.testing.assert_allclose(neighbour_weights(WAY_M, rows), expected, atol=1e-12)


def test_neighbours_whose_matches_move_as_they_do_support_a_loop_and_others_oppose_it(monkeypatch):
    line = [transform(2.0 * frame, 0.0, 0.0) for frame in range(50)]
    poses = np.stack(line + [transform(98.0 - 2.0 * frame, 1.0, np.pi) for frame in range(50)])
    true = [(query, 99 - query, inverse(poses[99 - query]) @ poses[query]) for query in range(60, 70)]
    wrong = (70, 38, transform(4.0, 1.0, 0.0))
    loops = [LoopClosure(*one, 1e-4 * np.eye(6), 0.9) for one in [*true, wrong]]
    evidence = Evidence.of(0.5, 0.1, 1.0, 0.0)  # log odds of 2 alone
    pairs = [Pair(loop, evidence, 2.0 * loop.query) for loop in loops]
    path, rules = DrivenPath(poses), {"drift": DriftModel()}
    found = sequence.tested_log_odds(pairs, MODEL, path, **rules)
    assert (found[:10] > 2).all() and found[10] < 2
    monkeypatch.setattr(sequence, "BLOCK", 3)
    np.testing.assert_allclose(sequence.tested_log_odds(pairs, MODEL, path, **rules), found)
    assert sequence.tested_log_odds([], MODEL, path, **rules).shape == (0,)


@pytest.mark.parametrize(
    ("ambiguity", "surprise", "reason"),
    [(0.5, 0.0, "too few neighbours"), (1.0, 2.0, "little similarity"), (1.0, 3.0, "repeats")],
)
def test_the_reason_of_a_rejection_is_what_is_missing(ambiguity, surprise, reason):
    pair = Pair(LoopClosure(9, 0, np.eye(4), np.eye(6), 0.5), Evidence.of(ambiguity, 0.1, 1.0, surprise), 90.0)
    assert rejection_reason(pair, MODEL, 0.99) == reason
