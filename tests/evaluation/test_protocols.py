from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sglpr_jax.evaluation.protocols import PROTOCOLS, Decision, protocols_taking
from sglpr_jax.evaluation.protocols.bevplace_recall_at_1 import bevplace_recall_at_1
from sglpr_jax.evaluation.protocols.pairs_f1max import pairs_f1max
from sglpr_jax.evaluation.protocols.top1_f1max import top1_f1max
from sglpr_jax.retrieval.descriptor_file import DescriptorFile

from .by_the_letter import distance, f1_max, random_drive

DESCRIPTORS = protocols_taking("descriptors")

UNPUBLISHED = "5 m, no published split: database is the first 60% of the frames, queries begin 20 m from its end"


def top1_by_the_letter(file: DescriptorFile) -> tuple[float, int]:
    """LoGG3D-Net's rule in loops: F1max and the number of revisits."""
    t, p, d = file.times, file.positions, file.descriptors
    answers = []
    for query in range(len(file)):
        if t[query] - t[0] < 30:
            continue
        first_younger = next(i for i in range(len(file)) if t[i] > t[query] - 30)
        database = range(min(first_younger + 1, query))
        best = min(database, key=lambda i: distance(d[query], d[i]))
        revisit = any(distance(p[query], p[i]) <= 3 for i in database)
        answers.append((distance(d[query], d[best]), distance(p[query], p[best]), revisit))

    def count(threshold):
        accepted = [apart for score, apart, _ in answers if score <= threshold]
        rejected = [revisit for score, _, revisit in answers if score > threshold]
        return sum(apart <= 3 for apart in accepted), sum(apart > 20 for apart in accepted), sum(rejected)

    return f1_max([score for score, _, _ in answers], count), sum(revisit for _, _, revisit in answers)


@given(st.integers(0, 10_000))
@settings(deadline=None, max_examples=15)
def test_top1_follows_the_rule_to_the_letter(make_file, seed):
    positions, descriptors, times = random_drive(seed)
    file = make_file(positions, descriptors, times=times)
    expected, revisits = top1_by_the_letter(file)
    result = top1_f1max(file)
    assert result.counts["revisits"] == revisits
    if revisits:
        assert result.score == pytest.approx(expected)
    else:
        assert np.isnan(result.score)


def pairs_by_the_letter(file: DescriptorFile) -> tuple[float, int, int]:
    """RINet's rule in loops with every negative: F1max, positive pairs, negative pairs."""
    p, d = file.positions[:, :2], file.descriptors
    pairs = [(i, j) for i in range(len(file)) for j in range(i)]
    positive = [distance(d[i], d[j]) for i, j in pairs if distance(p[i], p[j]) < 3 and i - j > 50]
    negative = [distance(d[i], d[j]) for i, j in pairs if distance(p[i], p[j]) > 20]

    def count(threshold):
        tp = sum(x <= threshold for x in positive)
        return tp, sum(x <= threshold for x in negative), len(positive) - tp

    return f1_max(positive, count) if positive else np.nan, len(positive), len(negative)


@given(st.integers(0, 10_000))
@settings(deadline=None, max_examples=10)
def test_pairs_follow_the_rule_to_the_letter(make_file, seed):
    positions, descriptors, _ = random_drive(seed, n=70)
    file = make_file(positions, descriptors)
    expected, positives, negatives = pairs_by_the_letter(file)
    result = pairs_f1max(file, negatives_per_positive=10_000)
    assert result.counts == {"positive pairs": positives, "negative pairs": negatives if positives else 0}
    assert result.score == pytest.approx(expected, nan_ok=True)


@pytest.mark.parametrize("name", DESCRIPTORS)
def test_descriptors_that_know_the_place_score_one(make_file, two_laps, name):
    result = PROTOCOLS[name](make_file(two_laps, two_laps / 200))
    assert result.score == 1.0
    assert result.interval == (1.0, 1.0)
    assert result.pose_source == "made up"
    assert result.published_on
    rule = PROTOCOLS[name].rule  # says in which plane, where it says so
    assert result.dimensions in ((3,) if "3-D" in rule else (2,) if "x and y" in rule else (2, 3))
    assert sum(result.counts.values()) > 0


@pytest.mark.slow
@pytest.mark.parametrize("name", DESCRIPTORS)
def test_the_interval_holds_the_score_and_every_result_has_another_name(make_file, two_laps, name):
    noise = np.random.default_rng(0).normal(scale=0.05, size=(800, 3))
    file = make_file(two_laps, two_laps / 200 + noise)
    result, again, other = (PROTOCOLS[name](file, seed=seed) for seed in (0, 0, 1))
    low, high = result.interval
    assert 0 < low <= result.score <= high <= 1
    assert high - low < 0.25
    assert again.interval == result.interval
    if 0 < result.score < 1:
        assert other.interval != result.interval
    assert [PROTOCOLS[other](file).name for other in DESCRIPTORS].count(result.name) == 1


# SGPR's positive pairs are mostly neighbours: it has a score on any recording.
@pytest.mark.parametrize("protocol", [PROTOCOLS[name] for name in DESCRIPTORS if name != "sgpr-pairs-f1max"])
def test_without_a_revisit_there_is_no_score(make_file, straight, protocol):
    result = protocol(make_file(straight, np.ones((800, 4))))
    assert np.isnan(result.score)
    assert result.curve is None
    assert result.interval is None
    assert result.counts.get("revisits", result.counts.get("positive pairs")) == 0


def test_a_drive_shorter_than_the_excluded_time_has_no_query(make_file, two_laps):
    result = top1_f1max(make_file(two_laps[:280], two_laps[:280]))
    assert result.counts == {"queries": 0, "revisits": 0}
    assert np.isnan(result.score)
    assert np.all(result.decisions == Decision.NOT_A_QUERY)


def test_top1_decides_every_frame(make_file, two_laps):
    descriptors = np.hstack([two_laps / 200, np.zeros((800, 1))])
    positions = two_laps.copy()
    descriptors[500] = descriptors[0]  # a revisit answered with a place 100 frames away
    descriptors[510] += [0, 0, 0, 9]  # a revisit that looks like nothing: rejected
    positions[520] += [0, 0, 10]  # no revisit, answered with a frame 10 m away
    result = top1_f1max(make_file(positions, descriptors))
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


def test_times_replace_the_290_frames(make_file, two_laps):
    slow = top1_f1max(make_file(two_laps, two_laps, times=np.arange(800) * 1.0))
    assert slow.counts["queries"] == 770
    assert slow.rule == "3 m / 20 m, last 30 s excluded"
    assert top1_f1max(make_file(two_laps, two_laps)).rule == "3 m / 20 m, last 290 frames excluded"


def test_top1_looks_at_height_and_pairs_do_not(make_file, two_laps):
    bridge = two_laps + np.where(np.arange(800) >= 400, 6.0, 0.0)[:, None] * [0, 0, 1]
    file = make_file(bridge, two_laps)
    assert top1_f1max(file).counts["revisits"] == 0
    assert bevplace_recall_at_1(file).counts["revisits"] == 1  # the last frame, of the first one of its lap
    assert pairs_f1max(file).score == 1.0


def test_negative_pairs_are_drawn_by_the_seed(make_file, two_laps):
    rng = np.random.default_rng(0)
    file = make_file(two_laps, two_laps / 200 + rng.normal(scale=0.2, size=(800, 3)))
    first, again, other = (pairs_f1max(file, seed=seed) for seed in (0, 0, 1))
    assert first.counts == {"positive pairs": 400, "negative pairs": 40_000}
    assert first.score == again.score != other.score
    assert abs(first.score - other.score) < 0.05
    fewer = pairs_f1max(file, negatives_per_positive=1)
    assert fewer.counts["negative pairs"] == 400
    assert fewer.score > first.score


@pytest.mark.parametrize(
    ("sequence", "frames", "queries", "rule"),
    [
        ("06", 1101, 301, "5 m, BEVPlace++ split: database 0 to 599, queries 800 to 1100"),
        ("06", 1100, 421, UNPUBLISHED),
        ("town", 1101, 422, UNPUBLISHED),
    ],
)
def test_bevplaces_split_is_used_for_kittis_sequences_alone(make_file, sequence, frames, queries, rule):
    there_and_back = np.abs(np.arange(frames) - frames // 2)[:, None] * [1.0, 0.0, 0.0]
    result = bevplace_recall_at_1(make_file(there_and_back, there_and_back, sequence=sequence))
    assert result.rule == rule
    assert result.counts == {"queries": queries, "revisits": queries}
    assert result.score == 1.0


def test_neighbours_across_the_seam_are_no_revisits(make_file):
    """Up a street and back by another one, 30 m away; at the end the robot stands still where it has been before."""
    up = np.arange(60.0)[:, None] * [1.0, 0, 0]
    back = up[::-1][:40] + np.array([0, 30, 0])
    alone = bevplace_recall_at_1(make_file(np.vstack([up, back]), np.ones((100, 4))))
    assert (alone.counts, np.isnan(alone.score)) == ({"queries": 40, "revisits": 0}, True)
    crawl = bevplace_recall_at_1(make_file(up[:50] * 0.1, np.ones((50, 4))))
    assert (crawl.counts, np.isnan(crawl.score)) == ({"queries": 0, "revisits": 0}, True)
    again = np.vstack([up, back[:30], np.repeat(up[:1], 10, axis=0)])
    found = bevplace_recall_at_1(make_file(again, again))
    assert (found.counts, found.score) == ({"queries": 40, "revisits": 10}, 1.0)


def test_recall_counts_only_queries_that_have_an_answer(make_file):
    map_part = np.arange(6.0)[:, None] * [100, 0, 0]
    query_part = np.array([[0, 4.9, 0], [100, 4.9, 0], [200, 5.0, 0], [900, 0, 0]])
    descriptors = np.vstack([np.eye(6), np.eye(6)[[0, 2, 2, 3]]])
    result = bevplace_recall_at_1(make_file(np.vstack([map_part, query_part]), descriptors))
    assert result.counts == {"queries": 4, "revisits": 2}
    assert result.score == 0.5
    assert result.decisions[6:].tolist() == [
        Decision.TRUE_POSITIVE,
        Decision.FALSE_NEGATIVE,
        Decision.UNCOUNTED,
        Decision.UNCOUNTED,
    ]


def test_blocks_leave_no_seam(make_file, monkeypatch):
    positions, descriptors, times = random_drive(3)
    file = make_file(positions, descriptors, times=times)
    whole = [protocol(file) for protocol in DESCRIPTORS.values()]
    for block in ("nearest.BLOCK", "pairs.BLOCK", "pairs.PAIR_BLOCK"):
        monkeypatch.setattr(f"sglpr_jax.evaluation.protocols.{block}", 7)
    monkeypatch.setattr("sglpr_jax.revisits.BLOCK", 7)
    for one, other in zip(whole, [protocol(file) for protocol in DESCRIPTORS.values()], strict=True):
        assert one.score == pytest.approx(other.score, nan_ok=True)
        assert one.counts == other.counts


@pytest.mark.parametrize("protocol", DESCRIPTORS.values())
def test_positions_are_needed(make_file, two_laps, protocol):
    file = replace(make_file(two_laps, two_laps), positions=None)
    with pytest.raises(ValueError, match="expected positions to score sequence town against, found none"):
        protocol(file)
