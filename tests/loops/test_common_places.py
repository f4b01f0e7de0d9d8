"""Loops between two recordings are accepted as a whole, or not at all."""

import numpy as np

from sglpr_jax.loops.closure import Loop
from sglpr_jax.loops.config import ConsistencyConfig
from sglpr_jax.loops.consistency import MIN_LOOPS, Joined, accepted_between
from sglpr_jax.odometry.config import DriftModel
from sglpr_jax.se3 import transform, travelled

from .drives import loop_at
from .pairs import loops_between, two_drives

RULES = {"drift": DriftModel(), "config": ConsistencyConfig()}
FIRST, SECOND, TRUE = two_drives()
JOINED = Joined(
    np.concatenate([FIRST, SECOND]),
    np.concatenate([travelled(FIRST), travelled(SECOND)]),
    np.repeat([0, 1], [len(FIRST), len(SECOND)]),
)


def joined_loops(true: np.ndarray) -> list[Loop]:
    """Loops by this transform, with the rows of both recordings, one after the other."""
    rng = np.random.default_rng(3)
    return [
        loop_at(len(FIRST) + one.query, one.match, one.match_from_query, rng)
        for one in loops_between(FIRST, SECOND, true)
    ]


def test_a_few_wrong_loops_are_rejected_and_the_others_accepted():
    right, rng = joined_loops(TRUE), np.random.default_rng(0)
    wrong = [
        loop_at(len(FIRST) + query, match, transform(*rng.uniform(-5, 5, 2), rng.uniform(-3, 3)), rng)
        for query, match in ((3, 40), (30, 5), (50, 70), (60, 20))
    ]
    mixed = sorted([*right, *wrong], key=lambda loop: loop.query)
    sets, rejected = accepted_between(mixed, JOINED, **RULES)
    assert [len(one) for one in sets] == [len(right)]
    assert {id(one.loop) for one in rejected} == set(map(id, wrong))
    assert {one.reason for one in rejected} == {"contradicts other loops"}


def test_too_few_loops_or_too_short_a_path_are_no_common_place():
    loops = joined_loops(TRUE)
    for some in (loops[: MIN_LOOPS - 1], loops[: MIN_LOOPS + 2], []):  # 5 loops are 2 m apart: 8 m
        sets, rejected = accepted_between(some, JOINED, **RULES)
        assert sets == [] and len(rejected) == len(some)
        assert {one.reason for one in rejected} <= {"too few neighbours"}


def test_a_place_that_repeats_gives_two_transforms_and_therefore_none():
    farther = transform(12.0, 0.0, 0.0) @ TRUE
    both = sorted([*joined_loops(TRUE), *joined_loops(farther)], key=lambda loop: loop.query)
    sets, rejected = accepted_between(both, JOINED, **RULES)
    assert sets == [] and len(rejected) == len(both)


def test_parts_without_known_motion_are_accepted_one_by_one():
    loops = joined_loops(TRUE)
    middle = int(np.median([loop.query for loop in loops]))
    parts = JOINED.parts + (np.arange(len(JOINED.parts)) > middle)
    sets, rejected = accepted_between(loops, JOINED._replace(parts=parts), **RULES)
    assert len(sets) == 2 and sum(map(len, sets)) == len(loops) and not rejected
