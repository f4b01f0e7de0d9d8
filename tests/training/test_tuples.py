"""Tuples follow their configuration and are a pure function of seed and step. Held-out places are far apart."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from recordings import of_images

from sglpr_jax.methods.recipe import TupleConfig
from sglpr_jax.training.config import ValidationConfig
from sglpr_jax.training.mining import DescriptorCache
from sglpr_jax.training.tuples import TuplePool, hold_out, worlds_of

LAP = 60


def circuit(laps: int, *, radius: float = 30, offset: float = 0.5, seed: int = 0) -> np.ndarray:
    """Several laps around one circle, about 3 m between frames, with some noise; heights are noise only."""
    angle = np.arange(laps * LAP) * (2 * np.pi / LAP)
    noise = np.random.default_rng(seed).normal(scale=offset, size=(len(angle), 2))
    across = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1) + noise
    return np.column_stack([across, np.random.default_rng(seed).normal(scale=50, size=len(angle))])


def columns(rows: np.ndarray, config: TupleConfig):
    return np.split(rows, [1, 1 + config.positives], axis=1)


def horizontal(pool: TuplePool, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.linalg.norm(pool.positions[a, :2] - pool.positions[b, :2], axis=-1)


@settings(deadline=None, max_examples=25)
@given(
    seed=st.integers(0, 10**6),
    step=st.integers(0, 10**6),
    positives=st.integers(1, 4),
    negatives=st.integers(0, 12),
    revisit_fraction=st.sampled_from([0.0, 0.5, 1.0]),
)
def test_positives_are_near_and_negatives_far(seed, step, positives, negatives, revisit_fraction):
    config = TupleConfig(positives, negatives, revisit_fraction=revisit_fraction, revisit_gap=LAP // 2)
    pool = TuplePool([circuit(3), circuit(2, seed=1)], config)
    rows = pool.draw(seed=seed, step=step, tuples=6)
    assert rows.shape == (6, 1 + positives + negatives)
    anchors, near, far = columns(rows, config)
    assert (horizontal(pool, anchors, near) < 3).all()
    assert (pool.recording_of[anchors] == pool.recording_of[near]).all()
    assert (anchors != near).all()
    assert ((horizontal(pool, anchors, far) > 20) | (pool.recording_of[anchors] != pool.recording_of[far])).all()
    gap = np.abs(pool.frame_of[anchors] - pool.frame_of[near])
    if revisit_fraction == 1:
        assert (gap > config.revisit_gap).all()
    if revisit_fraction == 0:
        assert (gap <= config.revisit_gap).all()


def test_all_pairs_within_three_metres_are_found_and_no_other():
    config = TupleConfig(revisit_gap=LAP // 2)
    recordings = [circuit(3), circuit(2, seed=1)]
    pool = TuplePool(recordings, config)
    for anchor in range(5 * LAP):
        recording, frame = pool.recording_of[anchor], pool.frame_of[anchor]
        near = np.flatnonzero(np.linalg.norm((recordings[recording] - recordings[recording][frame])[:, :2], axis=1) < 3)
        found = [
            np.sort(group.places[group.starts[anchor] : group.starts[anchor + 1]]) - (0 if recording == 0 else 3 * LAP)
            for group in (pool.neighbours, pool.revisits)
        ]
        same_visit = np.abs(near - frame) <= config.revisit_gap
        np.testing.assert_array_equal(found[0], near[same_visit & (near != frame)])
        np.testing.assert_array_equal(found[1], near[~same_visit])


def test_a_stop_is_one_visit_and_a_return_is_another():
    rng = np.random.default_rng(0)
    x = np.r_[np.arange(0, 60, 2.0) - 0.95, np.full(200, 60.0), np.arange(60, 0, -2.0)]  # a stop, then the way back
    recording = np.column_stack([x, 0 * x, 0 * x]) + rng.normal(scale=0.1, size=(len(x), 3))
    pool = TuplePool([recording, recording], TupleConfig(revisit_gap=20), worlds=[0, 0])
    stop, start, end = 60, 2, len(x) - 3
    visited = pool.are_of_one_visit(np.array([stop, stop, start, stop]), np.array([stop + 100, 25, end, len(x) + stop]))
    assert visited.tolist() == [True, False, False, False]
    revisits = pool.revisits.places[pool.revisits.starts[stop] : pool.revisits.starts[stop + 1]]
    assert (revisits >= len(x)).all()  # in the other recording only
    assert pool.revisits.anchors_among(np.array([start])).size


def test_three_metres_are_too_far_for_a_positive_and_twenty_too_near_for_a_negative():
    recording = np.zeros((5, 3))
    recording[:, 0] = [0, 3, 20, np.nextafter(3, 0), np.nextafter(20, 21)]
    pool = TuplePool([recording], TupleConfig())
    np.testing.assert_array_equal(pool.neighbours.places[: pool.neighbours.starts[1]], [3])
    np.testing.assert_array_equal(pool.far_apart(np.array(0), np.arange(5)), [False, False, False, False, True])


def test_a_positive_is_no_negative_of_its_anchor():
    TupleConfig(positive_m=20.0, negative_m=20.0)
    with pytest.raises(ValueError, match=r"negative_m of at least sampling\.positive_m, 25\.0, found 20\.0"):
        TupleConfig(positive_m=25.0)


def test_a_batch_is_a_pure_function_of_seed_and_step():
    pool = TuplePool([circuit(3)], TupleConfig(revisit_gap=LAP // 2))
    rows = pool.draw(seed=1, step=2, tuples=4)
    np.testing.assert_array_equal(pool.draw(seed=1, step=2, tuples=4), rows)
    np.testing.assert_array_equal(TuplePool([circuit(3)], pool.config).draw(seed=1, step=2, tuples=4), rows)
    for other in ((1, 3), (2, 2), (2, 1)):
        assert (pool.draw(seed=other[0], step=other[1], tuples=4) != rows).any()


def test_positives_are_neighbours_without_revisits_and_revisits_without_neighbours():
    config = TupleConfig(revisit_fraction=1.0)
    once = TuplePool([circuit(1)], config)
    assert len(once.draw(seed=0, step=0, tuples=5)) == 5
    sparse = np.tile(np.array([[0.0, 0, 0], [40, 0, 0]]), (40, 1))  # a place comes back only after frames elsewhere
    only_revisits = TuplePool([sparse], TupleConfig(revisit_fraction=0.0, revisit_gap=1))
    assert len(only_revisits.neighbours.anchors) == 0
    assert len(only_revisits.draw(seed=0, step=0, tuples=5)) == 5


def test_drives_without_positives_or_negatives_are_refused():
    with pytest.raises(ValueError, match=r"expected frames within 3\.0 m"):
        TuplePool([np.arange(30.0).reshape(10, 3) * 5], TupleConfig())
    pool = TuplePool([np.zeros((5, 3))], TupleConfig())
    with pytest.raises(ValueError, match=r"no frame lies farther than 20\.0 m from frame \d of the pool"):
        pool.draw(seed=0, step=0, tuples=1)


def test_the_anchors_of_a_cluster_lie_near_each_other_and_the_others_anywhere():
    street = np.column_stack([np.arange(0, 3000, 1.5), np.zeros((2000, 2))])
    config = TupleConfig(negatives=0, cluster=4, cluster_m=60.0)
    pool = TuplePool([street, street], config)
    anchors = pool.draw(seed=0, step=0, tuples=40)[:, 0].reshape(10, 4)
    assert (horizontal(pool, anchors[:, :1], anchors) <= 60).all()
    assert (pool.recording_of[anchors[:, :1]] == pool.recording_of[anchors]).all()
    assert np.ptp(pool.frame_of[anchors[:, 0]]) > 1000
    single = TuplePool([street, street], TupleConfig(negatives=0)).draw(seed=0, step=0, tuples=40)[:, 0]
    assert (np.abs(np.diff(pool.frame_of[single])) > 40).mean() > 0.8


def described(pool: TuplePool, places: np.ndarray | None = None) -> DescriptorCache:
    places = np.arange(len(pool)) if places is None else places
    return DescriptorCache(places, np.random.default_rng(3).normal(size=(len(places), 4)).astype(np.float32))


def test_mined_negatives_are_the_nearest_far_frames_of_brute_force():
    config = TupleConfig(negatives=5, mining="hardest", hardest=5, revisit_gap=LAP // 2)
    pool = TuplePool([circuit(3), circuit(2, seed=1)], config)
    cache = described(pool)
    anchors, near, far = columns(pool.draw(seed=0, step=0, tuples=20, cache=cache), config)
    assert (horizontal(pool, anchors, near) < 3).all()
    for anchor, row in zip(anchors[:, 0], far, strict=True):
        apart = (pool.recording_of != pool.recording_of[anchor]) | (
            horizontal(pool, np.array(anchor), np.arange(len(pool))) > 20
        )
        distance = np.linalg.norm(cache.descriptors - cache.descriptors[anchor], axis=1)
        expected = np.flatnonzero(apart)[np.argsort(distance[apart])[:5]]
        assert set(row.tolist()) == set(expected.tolist())


def test_mined_clusters_have_similar_descriptors_and_are_far_apart():
    config = TupleConfig(negatives=0, cluster=4, mining="hardest", hardest=5, revisit_gap=LAP // 2)
    pool = TuplePool([circuit(3), circuit(2, seed=1)], config)
    cache = described(pool)
    for row in pool.draw(seed=0, step=0, tuples=40, cache=cache)[:, 0].reshape(10, 4):
        apart = horizontal(pool, row[:, None], row[None]) + 100 * (
            pool.recording_of[row][:, None] != pool.recording_of[row][None]
        )
        assert (apart[~np.eye(4, dtype=bool)] > 20).all()
        distance = np.linalg.norm(cache.descriptors - cache.descriptors[row[0]], axis=1)
        # the source of positives may know fewer anchors, and others of the row take places: near the front all the same
        assert (np.argsort(np.argsort(distance))[row[1:]] < 60).all()


def test_anchors_and_negatives_are_among_the_described_places():
    config = TupleConfig(negatives=2, mining="hardest", revisit_gap=LAP // 2)
    pool = TuplePool([circuit(3)], config)
    some = np.arange(0, 3 * LAP, 4)
    rows = pool.draw(seed=0, step=0, tuples=20, cache=described(pool, some))
    assert np.isin(rows[:, [0, 2, 3]], some).all() and not np.isin(rows[:, 1], some).all()


def test_excluded_frames_are_in_no_tuple_and_the_others_keep_their_numbers():
    kept = np.r_[0:40, 100:180]
    config = TupleConfig(negatives=2, revisit_gap=LAP // 2)
    recordings = [circuit(3), circuit(1, seed=1)]
    pool = TuplePool(recordings, config, frames=[kept, np.arange(LAP)])
    np.testing.assert_array_equal(pool.frame_of, np.r_[kept, 0:LAP])
    np.testing.assert_array_equal(pool.positions, np.concatenate([recordings[0][kept], recordings[1]]))
    rows = pool.draw(seed=0, step=0, tuples=200)
    assert rows.max() < len(pool)
    for group, other_visit in ((pool.neighbours, False), (pool.revisits, True)):
        anchors = np.repeat(np.arange(len(pool)), np.diff(group.starts))
        assert ((np.abs(pool.frame_of[anchors] - pool.frame_of[group.places]) > LAP // 2) == other_visit).all()


def test_recordings_of_one_world_have_positives_and_no_near_negatives_in_each_other():
    config = TupleConfig(negatives=4, revisit_fraction=1.0, revisit_gap=LAP)
    pool = TuplePool([circuit(1), circuit(1, seed=1), circuit(1, seed=2)], config, worlds=[0, 1, 0])
    first, other, same = np.split(np.arange(3 * LAP), 3)
    np.testing.assert_array_equal(pool.world_of, np.repeat([0, 1, 0], LAP))
    assert np.isin(pool.revisits.anchors, np.r_[first, same]).all() and len(pool.revisits.anchors) > LAP
    anchors, near, far = columns(pool.draw(seed=0, step=0, tuples=200), config)
    assert (pool.recording_of[anchors] != pool.recording_of[near]).all()
    assert (horizontal(pool, anchors, near) < 3).all()
    assert ((horizontal(pool, anchors, far) > 20) | np.isin(far, other)).all() and np.isin(far, other).any()
    distances = pool.distances_from_anchors(np.stack([first, same, other], axis=1))
    np.testing.assert_allclose(distances[:, 1], horizontal(pool, first, same), rtol=1e-6)
    assert np.isinf(distances[:, 2]).all()


def test_recordings_without_a_world_have_one_of_their_own():
    recordings = [of_images({Path("1.png"): np.zeros((4, 4))}, world=world) for world in ("", "a", "", "a")]
    assert worlds_of(recordings) == [0, 1, 2, 1]


def test_the_held_out_stretch_is_held_out_of_every_recording_of_its_world():
    positions = np.column_stack([np.arange(0, 400, 2.0), np.zeros((200, 2))])
    other_positions = positions[::-1] + np.array([1.0, 1.0, 0.0])
    day, other_day = hold_out([positions, other_positions], ValidationConfig(share=0.25), SAMPLING)
    np.testing.assert_array_equal(day[1], np.arange(51))
    np.testing.assert_array_equal(other_day[1], np.arange(150, 200))
    np.testing.assert_array_equal(other_day[0], np.arange(140))


SAMPLING = TupleConfig(revisit_gap=20)


def wandering(seed: int, frames: int = 400) -> np.ndarray:
    """A recording of 2 m between frames that turns at random, so that it may cross itself; heights are noise."""
    rng = np.random.default_rng(seed)
    heading = np.cumsum(rng.normal(scale=0.15, size=frames))
    across = np.cumsum(2 * np.stack([np.cos(heading), np.sin(heading)], axis=1), axis=0)
    return np.column_stack([across, rng.normal(scale=50, size=frames)])


def apart(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.linalg.norm(a[:, None, :2] - b[None, :, :2], axis=-1)


@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 10**6), share=st.floats(0.02, 0.5))
def test_no_training_frame_lies_within_the_negative_distance_of_a_validation_frame(seed, share):
    positions = wandering(seed)
    ((training, validation),) = hold_out([positions], ValidationConfig(share=share), SAMPLING)
    assert not set(training) & set(validation)
    assert len(validation) >= round(share * len(positions))
    if len(training):
        assert apart(positions[training], positions[validation]).min() > SAMPLING.negative_m
    left_out = np.setdiff1d(np.arange(len(positions)), np.r_[training, validation])
    if len(left_out):
        assert apart(positions[left_out], positions[validation]).min(1).max() <= SAMPLING.negative_m


def test_the_held_out_stretch_contains_its_revisits_and_a_proportional_share_of_them():
    out_and_back = np.r_[np.arange(0, 600, 2.0), np.arange(600, 300, -2.0)]  # the second half of the way out comes back
    positions = np.column_stack([out_and_back, np.zeros((len(out_and_back), 2))])
    ((training, validation),) = hold_out([positions], ValidationConfig(share=0.1), SAMPLING)
    there, back = validation[validation < 300], validation[validation >= 300]
    assert len(there) and len(back)
    assert apart(positions[there], positions[back]).min(0).max() < SAMPLING.positive_m
    rows = training[training < 300]
    assert (positions[rows, 0] > 300).sum() > 60  # most of what is revisited is still trained on


def test_without_revisits_the_first_frames_are_held_out_and_with_share_0_none():
    positions = np.column_stack([np.arange(0, 400, 2.0), np.zeros((200, 2))])
    ((training, validation),) = hold_out([positions], ValidationConfig(share=0.25), SAMPLING)
    np.testing.assert_array_equal(validation, np.arange(51))  # and the one frame less than 3 m further on
    np.testing.assert_array_equal(training, np.arange(61, 200))
    ((training, validation),) = hold_out([positions], ValidationConfig(), SAMPLING)
    assert len(validation) == 0 and len(training) == 200
