"""The scores of weights equal those of a search by hand."""

from pathlib import Path

import numpy as np
import pytest
from recordings import of_images

from sglpr_jax.data.recording import Recording
from sglpr_jax.methods.recipe import TupleConfig
from sglpr_jax.models.config import ModelConfig
from sglpr_jax.models.weights import Params
from sglpr_jax.retrieval.distances import distance_function
from sglpr_jax.training import validation
from sglpr_jax.training.config import TrainConfig
from sglpr_jax.training.tuples import TuplePool
from sglpr_jax.training.validation import recall_and_f1_max, recall_at_1, validation_score

PARAMS = Params({}, ModelConfig())


def recording(seed: int, laps: int = 2) -> np.ndarray:
    """Laps around one circle, about 3.1 m between frames at a radius of 30 m."""
    angle = np.arange(60 * laps) * (2 * np.pi / 60)
    noise = np.random.default_rng(seed).normal(scale=0.8, size=(len(angle), 2))
    return np.column_stack([30 * np.stack([np.cos(angle), np.sin(angle)], axis=1) + noise, np.zeros(len(angle))])


@pytest.fixture
def pool() -> TuplePool:
    config = TupleConfig(revisit_gap=20)
    return TuplePool([recording(0), recording(1)], config, frames=[np.r_[10:40, 70:100], np.arange(30)])


def by_hand(descriptors: np.ndarray, pool: TuplePool, gap: int) -> tuple[float, float]:
    """Recall@1, and the best F1 over all thresholds, query by query."""
    answers = []
    for i in range(len(pool)):
        same = pool.recording_of == pool.recording_of[i]
        open_ = ~(same & (np.abs(pool.frame_of - pool.frame_of[i]) <= gap))
        apart = np.where(same, np.linalg.norm((pool.positions - pool.positions[i])[:, :2], axis=1), np.inf)
        distance = np.where(open_, np.linalg.norm(descriptors - descriptors[i], axis=1), np.inf)
        best = int(distance.argmin())
        answers.append((distance[best], apart[best] < 3, apart[best] > 20, bool((apart[open_] < 3).any())))
    score, right, wrong, there = (np.array(column) for column in zip(*answers, strict=True))
    f1 = []
    for threshold in score:
        accepted = score <= threshold
        tp, fp = (accepted & right).sum(), (accepted & wrong).sum()
        fn = (~accepted & there).sum()
        f1.append(2 * tp / max(2 * tp + fp + fn, 1))
    return float(right[there].mean()), float(max(f1))


@pytest.mark.parametrize("gap", [0, 20])
@pytest.mark.parametrize("noise", [0.05, 3.0, 30.0])
def test_recall_and_f1_max_equal_a_search_by_hand(monkeypatch, pool, gap, noise):
    monkeypatch.setattr(validation, "QUERIES", 7)  # several blocks
    places = pool.positions[:, :2] + 300 * pool.recording_of[:, None]
    descriptors = (places + np.random.default_rng(5).normal(scale=noise, size=places.shape)).astype(np.float32)
    found = recall_and_f1_max(descriptors, pool, revisits_only=gap > 0)
    np.testing.assert_allclose(found, by_hand(descriptors, pool, gap), atol=1e-12)


def sequence(positions: np.ndarray) -> Recording:
    """No more of a recording than its positions."""
    paths = tuple(Path(f"{i:06d}.png") for i in range(len(positions)))
    return of_images(dict.fromkeys(paths, np.zeros((4, 4))), name="00", positions=positions)


def test_the_score_uses_revisits_if_there_are_any_and_neighbours_otherwise(monkeypatch):
    def positions_with_noise(params, recordings, pool, places, angles, config):
        assert len(places) == len(angles) == len(pool) and np.ptp(angles) > 3
        return pool.positions[places].astype(np.float32)

    monkeypatch.setattr(validation, "describe_places", positions_with_noise)
    config = TrainConfig(sampling=TupleConfig(revisit_gap=20))
    frames = [np.r_[10:40, 70:100]]
    assert validation_score([sequence(recording(0))], frames, config)(PARAMS) == {
        "score": 1.0,
        "recall_neighbours": 1.0,
        "recall_revisits": 1.0,
        "f1max": 1.0,
    }
    street = np.column_stack([np.arange(60.0), np.zeros((60, 2))])
    assert set(validation_score([sequence(street)], [np.arange(40)], config)(PARAMS)) == {"score", "recall_neighbours"}


def test_a_held_out_part_without_two_frames_of_one_place_is_refused():
    street = np.column_stack([np.arange(60.0) * 10, np.zeros((60, 2))])
    with pytest.raises(ValueError, match=r"validation\.share is too small: expected frames within 3\.0 m"):
        validation_score([sequence(street)], [np.arange(5)], TrainConfig())


def test_recall_at_1_equals_a_count_by_hand():
    rng = np.random.default_rng(0)
    positions, descriptors = rng.uniform(0, 20, (120, 3)), rng.normal(size=(120, 4)).astype(np.float32)
    times = np.arange(120) * 1.0
    hits = asked = 0
    for i in range(30, 120):
        old = [j for j in range(i) if times[j] <= times[i] - 30] + [i - 29]
        near = [np.hypot(*(positions[i] - positions[j])[:2]) <= 5 for j in old]
        if any(near):
            asked += 1
            hits += near[int(np.argmin([np.linalg.norm(descriptors[i] - descriptors[j]) for j in old]))]
    distance = distance_function("l2")
    assert recall_at_1(descriptors, positions, times, distance) == pytest.approx(hits / asked)
