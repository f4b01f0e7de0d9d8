"""Each protocol against its rule in plain loops, on recordings small enough for them."""

import numpy as np
import pytest

from sglpr_jax.evaluation.protocols.bevplace_nclt_recall import bevplace_nclt_recall
from sglpr_jax.evaluation.protocols.bevplace_v1_recall import bevplace_v1_recall
from sglpr_jax.evaluation.protocols.contour_context_f1max import contour_context_f1max
from sglpr_jax.evaluation.protocols.overlap_transformer_f1max import overlap_transformer_f1max
from sglpr_jax.evaluation.protocols.pairs_f1max import pairs_f1max
from sglpr_jax.evaluation.protocols.pointnetvlad_recall import pointnetvlad_recall
from sglpr_jax.evaluation.protocols.scan_context_f1max import scan_context_f1max
from sglpr_jax.evaluation.protocols.sgpr_pairs_f1max import sgpr_pairs_f1max
from sglpr_jax.evaluation.protocols.ssc_recall import ssc_recall
from sglpr_jax.evaluation.protocols.top1_strict_f1max import top1_strict_f1max

from .by_the_letter import distance, f1_max, random_drive, recall, top1

SEEDS = (0, 1, 2)


@pytest.fixture(params=SEEDS)
def recording(request, make_file):
    """A random recording of 230 frames without times, long enough for a gap of 150 frames."""
    positions, descriptors, _ = random_drive(request.param, n=230)
    return make_file(positions, descriptors)


def within(file, metres, dimensions, *, closed=False):
    positions = file.positions[:, :dimensions]

    def right(i, j):
        apart = distance(positions[i], positions[j])
        return apart <= metres if closed else apart < metres

    return right


def assert_is_top1(result, expected):
    score, revisits, recall_at_1 = expected
    assert result.score == pytest.approx(score)
    assert result.counts["revisits"] == revisits
    assert result.recalls[1] == pytest.approx(recall_at_1)


@pytest.mark.parametrize("seed", SEEDS)
def test_strict_top1_forgives_no_near_miss(make_file, seed):
    positions, descriptors, times = random_drive(seed)
    file = make_file(positions, descriptors, times=times)
    databases = {}
    for query in np.flatnonzero(times - times[0] >= 30):
        first_younger = np.flatnonzero(times > times[query] - 30)[0]
        databases[query] = range(min(first_younger + 1, query))
    assert_is_top1(top1_strict_f1max(file), top1(file, databases, within(file, 3, 3, closed=True)))


def test_scan_context_leaves_out_the_last_49_frames_and_the_last_query(recording):
    databases = {i: range(i - 48) for i in range(49, 229)}
    result = scan_context_f1max(recording)
    assert result.counts["queries"] == 180
    assert_is_top1(result, top1(recording, databases, within(recording, 5, 2)))


def test_contour_context_leaves_out_150_frames(recording):
    databases = {i: range(i - 150) for i in range(151, 230)}
    result = contour_context_f1max(recording)
    assert result.counts["queries"] == 79
    assert_is_top1(result, top1(recording, databases, within(recording, 5, 3)))


def test_overlap_transformer_starts_f1max_at_150_and_recall_at_101(recording):
    rng = np.random.default_rng(0)
    listed = np.argwhere(rng.random((230, 230)) < 0.02)
    pairs = {(i, j) for i, j in listed.tolist()}
    result = overlap_transformer_f1max(recording, listed)
    databases = {i: range(i - 100) for i in range(101, 229)}
    late = {i: database for i, database in databases.items() if i >= 150}
    score, revisits, _ = top1(recording, late, lambda i, j: (i, j) in pairs)
    assert result.score == pytest.approx(score)
    assert result.counts == {"queries": 79, "revisits": revisits}
    assert sorted(result.recalls) == [1, 2, 5, 10, 20]  # 1 % of 230 frames is 2
    for n, value in result.recalls.items():
        assert value == pytest.approx(recall(recording, databases, lambda i, j: (i, j) in pairs, n))


def test_overlap_transformer_takes_15_m_where_no_overlaps_are_given(recording):
    near = within(recording, 15, 2)
    listed = np.array([(i, j) for i in range(230) for j in range(i) if near(i, j)])
    stand_in, given = overlap_transformer_f1max(recording), overlap_transformer_f1max(recording, listed)
    assert (stand_in.score, stand_in.recalls) == (given.score, given.recalls)
    assert stand_in.rule == "15 m in place of overlaps, gap 100 frames"
    assert given.rule == "overlap above 0.3, gap 100 frames"
    assert (stand_in.dimensions, given.dimensions) == (2, None)


def test_ssc_recall_asks_every_frame_that_has_something_to_find(recording):
    databases = {i: range(i - 50) for i in range(51, 230)}
    right = within(recording, 5, 2, closed=True)
    result = ssc_recall(recording)
    queries = sum(any(right(i, j) for j in database) for i, database in databases.items())
    assert result.counts == {"queries": queries, "revisits": queries}
    assert list(result.recalls) == list(range(1, 26))
    for n in (1, 3, 25):
        assert result.recalls[n] == pytest.approx(recall(recording, databases, right, n))


def test_bevplace_v1_is_two_dimensional_and_looks_20_deep(make_file):
    positions, descriptors, _ = random_drive(4, n=1101)
    file = make_file(positions * 8, descriptors, sequence="06")
    databases = {i: range(600) for i in range(800, 1101, 7)}
    thinned = recall(file, databases, within(file, 5, 2), 5)
    result = bevplace_v1_recall(file)
    assert list(result.recalls) == [1, 5, 10, 20]
    assert result.rule == "5 m, BEVPlace split: database 0 to 599, queries 800 to 1100"
    assert result.recalls[5] == pytest.approx(thinned, abs=0.1)
    assert result.recalls[1] < result.recalls[5] < result.recalls[20]


def test_bevplace_v1_leaves_out_ten_frames_of_05(make_file):
    there_and_back = np.abs(np.arange(2761) - 1380)[:, None] * [1.0, 0.0, 0.0]
    result = bevplace_v1_recall(make_file(there_and_back, there_and_back, sequence="05"))
    assert result.counts["queries"] == 1551
    assert result.rule.endswith("queries 1200 to 2750")


@pytest.mark.parametrize("seed", SEEDS)
def test_pairs_of_all_negatives_and_of_any_ratio(make_file, seed):
    positions, descriptors, _ = random_drive(seed, n=70)
    file = make_file(positions * 2, descriptors)
    everything, plenty = (pairs_f1max(file, negatives_per_positive=ratio) for ratio in (None, 10_000))
    assert everything.score == plenty.score
    assert everything.counts == plenty.counts
    few = pairs_f1max(file, negatives_per_positive=2)
    assert few.counts["negative pairs"] == 2 * few.counts["positive pairs"]
    assert [result.name for result in (everything, few)] == ["pairs F1max 1:all", "pairs F1max 1:2"]


@pytest.mark.parametrize("seed", SEEDS)
def test_sgpr_pairs_have_no_gap_and_few_negatives(make_file, monkeypatch, seed):
    positions, descriptors, _ = random_drive(seed, n=70)
    file = make_file(positions, descriptors)
    p, d = file.positions[:, :2], file.descriptors
    pairs = [(i, j) for i in range(70) for j in range(i, 70)]
    positive = [distance(d[i], d[j]) for i, j in pairs if distance(p[i], p[j]) <= 3]
    negative = [distance(d[i], d[j]) for i, j in pairs if distance(p[i], p[j]) > 20]

    def count(threshold):
        tp = sum(x <= threshold for x in positive)
        return tp, sum(x <= threshold for x in negative), len(positive) - tp

    monkeypatch.setattr("sglpr_jax.evaluation.protocols.sgpr_pairs_f1max.NEGATIVE_SHARE", 1.0)
    result = sgpr_pairs_f1max(file)
    assert result.counts == {"positive pairs": len(positive), "negative pairs": len(negative)}
    assert result.score == pytest.approx(f1_max(positive, count))


def test_sgpr_keeps_one_negative_in_200(make_file, two_laps):
    result = sgpr_pairs_f1max(make_file(two_laps, two_laps))
    assert result.counts["positive pairs"] == 800 + 400  # each frame with itself, and with the same of the other lap
    assert result.counts["negative pairs"] == pytest.approx(0.005 * 800 * 799 / 2, rel=0.1)


@pytest.fixture
def sessions(make_file):
    """Three sessions over the same ground, of 150, 60 and 90 frames."""
    files = []
    for seed, n in enumerate((150, 60, 90)):
        positions, _, _ = random_drive(seed, n=n)
        descriptors = (positions + np.random.default_rng(seed).normal(scale=4, size=(n, 3))) / 20
        files.append(make_file(positions * 5, descriptors, sequence=f"session {seed}"))
    return files


def across(database, queries, metres, n):
    """Recall@n across two sessions, and how many queries have something to find."""
    found = []
    for position, descriptor in zip(queries.positions, queries.descriptors, strict=True):
        near = [distance(position[:2], p[:2]) < metres for p in database.positions]
        order = np.argsort([distance(descriptor, d) for d in database.descriptors])
        if any(near):
            found.append(any(near[i] for i in order[:n]))
    return np.mean(found), len(found)


def test_nclt_recall_is_asked_across_two_sessions(sessions):
    database, queries, _ = sessions
    result = bevplace_nclt_recall(database, queries)
    expected, revisits = across(database, queries, 5, 1)
    assert 0 < expected < 1
    assert result.score == pytest.approx(expected)
    assert result.counts == {"queries": 60, "revisits": revisits}
    assert result.rule == "5 m, database session 0, queries session 1"
    assert result.interval[0] < expected < result.interval[1]


@pytest.mark.slow
def test_pointnetvlad_recall_is_the_mean_over_ordered_pairs_of_runs(sessions):
    result = pointnetvlad_recall(*sessions)
    ordered = [(a, b) for a in sessions for b in sessions if a is not b]
    one_percent = {150: 2, 60: 1, 90: 1}
    assert result.score == pytest.approx(np.mean([across(a, b, 25, one_percent[len(a)])[0] for a, b in ordered]))
    for n in (1, 5, 25):
        assert result.recalls[n] == pytest.approx(np.mean([across(a, b, 25, n)[0] for a, b in ordered]))
    revisits = sum(across(a, b, 25, 1)[1] for a, b in ordered)
    assert result.counts == {"session pairs": 6, "queries": 600, "revisits": revisits}
    assert result.interval[0] < result.score < result.interval[1]


def test_a_run_elsewhere_is_no_part_of_the_mean(make_file, sessions):
    near, far = sessions[0], make_file(sessions[1].positions + 1e4, sessions[1].descriptors)
    alone, joined = pointnetvlad_recall(near, sessions[2]), pointnetvlad_recall(near, sessions[2], far)
    assert joined.score == alone.score
    assert joined.counts["session pairs"] == alone.counts["session pairs"] == 2
    nothing = pointnetvlad_recall(near, far)
    assert np.isnan(nothing.score) and nothing.counts["revisits"] == 0
    assert np.isnan(bevplace_nclt_recall(near, far).score)
