"""Each protocol equals its rule in plain loops. Properties of all protocols."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sglpr_jax.evaluation.protocols import PROTOCOLS, protocols_taking
from sglpr_jax.evaluation.protocols.pairs import (
    PAIRS_F1MAX,
    SGPR_PAIRS_F1MAX,
    are_apart,
    drawn_frame_pairs,
    frame_pairs,
)
from sglpr_jax.evaluation.protocols.recall import (
    BEVPLACE_NCLT_RECALL,
    BEVPLACE_RECALL_AT_1,
    BEVPLACE_V1_RECALL,
    POINTNETVLAD_RECALL,
    SSC_RECALL,
)
from sglpr_jax.evaluation.protocols.result import Decision
from sglpr_jax.evaluation.protocols.top1 import (
    CONTOUR_CONTEXT_F1MAX,
    OVERLAP_TRANSFORMER_F1MAX,
    SCAN_CONTEXT_F1MAX,
    TOP1_F1MAX,
)

from .by_the_letter import pairs, random_drive, recall, recall_across, top1, within

DESCRIPTORS = protocols_taking("descriptors")
UNPUBLISHED = "5 m, no published split: database is the first 60% of the path, queries begin 20 m from its end"


@pytest.fixture(scope="module")
def recording(make_file):
    """Return a random recording of 230 frames without times, long enough for a gap of 150 frames."""
    positions, descriptors, _ = random_drive(0, n=230)
    return make_file(positions, descriptors)


@given(st.integers(0, 10_000))
@settings(deadline=None, max_examples=15)
def test_top1_equals_the_rule_in_plain_loops(make_file, seed):
    positions, descriptors, times = random_drive(seed)
    file = make_file(positions, descriptors, times=times)
    databases = {}
    for query in np.flatnonzero(times - times[0] >= 30):
        first_younger = np.flatnonzero(times > times[query] - 30)[0]
        databases[query] = range(min(first_younger + 1, query))
    near = within(file, 20, 3, closed=True)
    expected = top1(file, databases, within(file, 3, 3, closed=True), lambda i, j: not near(i, j))
    result = TOP1_F1MAX(file)
    found = result.score, result.counts["revisits"], result.recalls.get(1, np.nan)
    assert found == pytest.approx(expected if expected[1] else (np.nan, 0, np.nan), nan_ok=True)


@pytest.mark.parametrize(
    ("protocol", "databases", "metres", "dimensions"),
    [
        (SCAN_CONTEXT_F1MAX, {i: range(i - 48) for i in range(49, 229)}, 5, 2),
        (CONTOUR_CONTEXT_F1MAX, {i: range(i - 150) for i in range(151, 230)}, 5, 3),
        (OVERLAP_TRANSFORMER_F1MAX, {i: range(i - 100) for i in range(150, 229)}, 15, 2),
    ],
)
def test_protocols_with_a_gap_equal_their_rule_in_plain_loops(recording, protocol, databases, metres, dimensions):
    result, near = protocol(recording), within(recording, metres, dimensions)
    score, revisits, recall_at_1 = top1(recording, databases, near)
    assert result.score == pytest.approx(score)
    assert result.counts == {"queries": len(databases), "revisits": revisits}
    if protocol is OVERLAP_TRANSFORMER_F1MAX:  # recall begins at 101
        databases = {i: range(i - 100) for i in range(101, 229)}
        assert sorted(result.recalls) == [1, 2, 5, 10, 20]  # 1 % of 230 frames is 2
        for n, value in result.recalls.items():
            assert value == pytest.approx(recall(recording, databases, near, n))
    else:
        assert result.recalls == {1: pytest.approx(recall_at_1)}


def test_top1_decides_every_frame(make_file, two_laps):
    descriptors = np.hstack([two_laps / 200, np.zeros((800, 1))])
    positions = two_laps.copy()
    descriptors[500] = descriptors[0]  # a revisit answered with a place 100 frames away
    descriptors[510] += [0, 0, 0, 9]  # a revisit that looks like nothing: rejected
    positions[520] += [0, 0, 10]  # no revisit, answered with a frame 10 m away
    result = TOP1_F1MAX(make_file(positions, descriptors))
    # Frames 290 to 399 are queries in the first lap, with nothing to find and nothing that looks alike.
    assert result.counts == {"queries": 510, "revisits": 399}
    decisions = result.decisions
    assert np.all(decisions[:290] == Decision.NOT_A_QUERY)
    assert np.all(decisions[290:399] == Decision.TRUE_NEGATIVE)
    assert decisions[500] == Decision.FALSE_POSITIVE
    assert decisions[510] == Decision.FALSE_NEGATIVE
    assert decisions[520] == Decision.UNCOUNTED
    assert np.sum(decisions == Decision.TRUE_POSITIVE) == 398 - 1
    # The frame 500 is no false negative, however wrong its answer: it was not rejected.
    assert result.score == pytest.approx(2 * 397 / (2 * 397 + 1 + 1))
    queries = decisions != Decision.NOT_A_QUERY
    assert np.all(result.answers[~queries] == -1) and np.all(np.isinf(result.answer_distances[~queries]))
    assert np.all(result.answers[queries] < np.flatnonzero(queries))


@given(st.integers(0, 10_000))
@settings(deadline=None, max_examples=10)
def test_pairs_equal_the_rule_in_plain_loops(make_file, seed):
    positions, descriptors, _ = random_drive(seed, n=70)
    file = make_file(positions * 1.5, descriptors)
    expected, counts = pairs(file, lambda apart, gap: apart < 3 and gap > 50)
    every, plenty, few = (replace(PAIRS_F1MAX, negatives_per_positive=ratio)(file) for ratio in (None, 10_000, 2))
    assert every.counts == counts and every.score == pytest.approx(expected, nan_ok=True)
    if counts["positive pairs"]:
        assert (plenty.counts, plenty.score) == (every.counts, every.score)
    assert few.counts["negative pairs"] == 2 * few.counts["positive pairs"]


def test_sgpr_pairs_have_no_gap_and_few_negatives(make_file, two_laps):
    positions, descriptors, _ = random_drive(0, n=70)
    file = make_file(positions, descriptors)
    expected, counts = pairs(file, lambda apart, gap: apart <= 3, first_gap=0)
    result = replace(SGPR_PAIRS_F1MAX, negatives_share=1.0)(file)
    assert result.counts == counts and result.score == pytest.approx(expected)
    laps = SGPR_PAIRS_F1MAX(make_file(two_laps, two_laps))
    assert laps.counts["positive pairs"] == 800 + 400  # each frame with itself, and with the same of the other lap
    assert laps.counts["negative pairs"] == pytest.approx(0.005 * 800 * 799 / 2, rel=0.1)


@given(st.integers(0, 10_000), st.sampled_from([0, 1, 150, 6000, 10**6]))
@settings(deadline=None, max_examples=15)
def test_drawn_pairs_equal_a_draw_from_the_list_of_all_pairs(seed, most):
    positions = 4 * random_drive(seed, n=200)[0][:, :2]  # most pairs are more than 20 m apart
    every = frame_pairs(positions, are_apart)
    expected = np.random.default_rng(seed).choice(every, min(most, len(every)), replace=False)
    found = drawn_frame_pairs(positions, are_apart, max_pairs=most, rng=np.random.default_rng(seed))
    np.testing.assert_array_equal(found, np.sort(expected))


def test_queries_of_ssc_recall_are_all_revisits(recording):
    databases = {i: range(i - 50) for i in range(51, 230)}
    right = within(recording, 5, 2, closed=True)
    result = SSC_RECALL(recording)
    queries = sum(any(right(i, j) for j in database) for i, database in databases.items())
    assert result.counts == {"queries": queries, "revisits": queries}
    assert list(result.recalls) == list(range(1, 26))
    for n in (1, 3, 25):
        assert result.recalls[n] == pytest.approx(recall(recording, databases, right, n))


@pytest.mark.parametrize(
    ("protocol", "sequence", "frames", "queries", "rule"),
    [
        (BEVPLACE_RECALL_AT_1, "06", 1101, 301, "5 m, BEVPlace++ split: database 0 to 599, queries 800 to 1100"),
        (BEVPLACE_RECALL_AT_1, "06", 1100, 421, UNPUBLISHED),
        (BEVPLACE_RECALL_AT_1, "town", 1101, 422, UNPUBLISHED),
        (BEVPLACE_V1_RECALL, "05", 2761, 1551, "5 m, BEVPlace split: database 0 to 999, queries 1200 to 2750"),
    ],
)
def test_the_split_of_bevplace_is_used_for_kitti_sequences_only(make_file, protocol, sequence, frames, queries, rule):
    there_and_back = np.abs(np.arange(frames) - frames // 2)[:, None] * [1.0, 0.0, 0.0]
    result = protocol(make_file(there_and_back, there_and_back, sequence=sequence))
    assert result.rule == rule
    assert result.counts["queries"] == queries
    assert list(result.recalls) == list(protocol.numbers) and set(result.recalls.values()) == {1.0}


def test_frames_next_to_the_end_of_the_database_are_no_queries(make_file):
    """The robot drives along a street, returns 30 m beside it, and stops at an earlier position."""
    up = np.arange(60.0)[:, None] * [1.0, 0, 0]
    back = up[::-1][:40] + np.array([0, 30, 0])
    alone = BEVPLACE_RECALL_AT_1(make_file(np.vstack([up, back]), np.ones((100, 4))))
    assert (alone.counts, np.isnan(alone.score)) == ({"queries": 40, "revisits": 0}, True)
    crawl = BEVPLACE_RECALL_AT_1(make_file(up[:50] * 0.1, np.ones((50, 4))))
    assert (crawl.counts, np.isnan(crawl.score)) == ({"queries": 0, "revisits": 0}, True)
    again = np.vstack([up, back[:30], np.repeat(up[:1], 10, axis=0)])
    found = BEVPLACE_RECALL_AT_1(make_file(again, again))
    assert (found.counts, found.score) == ({"queries": 13, "revisits": 10}, 1.0)


def test_a_stop_at_the_start_leaves_the_queries(make_file, two_laps):
    parked = np.concatenate([np.repeat(two_laps[:1], 1600, axis=0), two_laps])
    moving, stopped = (BEVPLACE_RECALL_AT_1(make_file(places, places)) for places in (two_laps, parked))
    assert stopped.counts == moving.counts


@pytest.fixture(scope="module")
def sessions(make_file):
    """Return three sessions in the same area, of 150, 60 and 90 frames."""
    files = []
    for seed, n in enumerate((150, 60, 90)):
        positions, _, _ = random_drive(seed, n=n)
        descriptors = (positions + np.random.default_rng(seed).normal(scale=4, size=(n, 3))) / 20
        files.append(make_file(positions * 5, descriptors, sequence=f"session {seed}"))
    return files


def test_nclt_recall_of_one_session_in_another(sessions):
    database, queries, _ = sessions
    result = BEVPLACE_NCLT_RECALL(database, queries)
    expected, revisits = recall_across(database, queries, 5, 1)
    assert 0 < expected < 1
    assert result.score == pytest.approx(expected)
    assert result.counts == {"queries": 60, "revisits": revisits}
    assert result.rule == "5 m, database session 0, queries session 1"
    assert result.interval[0] < expected < result.interval[1]


def test_pointnetvlad_recall_is_the_mean_over_ordered_pairs_of_runs(make_file, sessions):
    result = POINTNETVLAD_RECALL(*sessions)
    ordered = [(a, b) for a in sessions for b in sessions if a is not b]
    one_percent = {150: 2, 60: 1, 90: 1}
    expected = [recall_across(a, b, 25, one_percent[len(a)]) for a, b in ordered]
    assert result.score == pytest.approx(np.mean([score for score, _ in expected]))
    assert result.recalls[5] == pytest.approx(np.mean([recall_across(a, b, 25, 5)[0] for a, b in ordered]))
    assert list(result.recalls) == list(range(1, 26))
    revisits = sum(revisits for _, revisits in expected)
    assert result.counts == {"session pairs": 6, "queries": 600, "revisits": revisits}
    assert result.interval[0] < result.score < result.interval[1]
    elsewhere = make_file(sessions[1].positions + 1e4, sessions[1].descriptors)
    alone, joined = POINTNETVLAD_RECALL(*sessions[::2]), POINTNETVLAD_RECALL(*sessions[::2], elsewhere)
    assert joined.score == alone.score and joined.counts["session pairs"] == alone.counts["session pairs"] == 2
    assert np.isnan(POINTNETVLAD_RECALL(sessions[0], elsewhere).score)
    with pytest.raises(ValueError, match="expected at least two sessions, found 1"):
        POINTNETVLAD_RECALL(sessions[0])


@pytest.mark.parametrize("name", DESCRIPTORS)
def test_perfect_descriptors_have_score_one(make_file, two_laps, noisy_laps, straight, name):
    protocol, file = PROTOCOLS[name], make_file(two_laps, two_laps / 200)
    noisy, other = (protocol(noisy_laps, seed=seed) for seed in (0, 1))
    low, high = noisy.interval
    assert 0 < low <= noisy.score <= high <= 1 and high - low < 0.25
    assert noisy.score == 1 or other.interval != noisy.interval
    assert [other.title for other in PROTOCOLS.values()].count(noisy.name) == 1
    result = protocol(file)
    assert (result.score, result.interval, result.pose_source) == (1.0, (1.0, 1.0), "made up")
    assert result.published_on
    assert result.dimensions == (3 if "3-D" in protocol.rule else 2)  # the rule says in which plane
    if name != "sgpr-pairs-f1max":  # its positive pairs are mostly neighbours, so it has a score on any recording
        nothing = protocol(make_file(straight, np.ones((800, 4))))
        assert np.isnan(nothing.score) and nothing.curve is None and nothing.interval is None
    alike = protocol(make_file(two_laps, np.ones((800, 4))))
    assert 0 <= alike.interval[0] <= alike.score <= alike.interval[1] <= 1
    assert alike.curve is None or len(alike.curve.thresholds) == 1
    two_frames = protocol(make_file(np.array([[0.0, 0, 0], [100, 0, 0]]), np.ones((2, 4))))
    assert np.isnan(two_frames.score) or name == "sgpr-pairs-f1max"
    with pytest.raises(ValueError, match="expected positions to score sequence town against, found none"):
        protocol(replace(file, positions=None))


def test_scores_do_not_depend_on_block_sizes(make_file, monkeypatch):
    positions, descriptors, times = random_drive(3)
    file = make_file(positions, descriptors, times=times)
    whole = [protocol(file) for protocol in DESCRIPTORS.values()]
    for block in ("protocol.BLOCK", "pairs.BLOCK", "pairs.PAIR_BLOCK"):
        monkeypatch.setattr(f"sglpr_jax.evaluation.protocols.{block}", 7)
    monkeypatch.setattr("sglpr_jax.revisits.BLOCK_QUERIES", 7)
    for one, other in zip(whole, [protocol(file) for protocol in DESCRIPTORS.values()], strict=True):
        assert one.score == pytest.approx(other.score, nan_ok=True)
        assert one.counts == other.counts
