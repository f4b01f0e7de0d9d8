"""Every tuple is what its configuration says, and a pure function of seed and step."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sglpr_jax.data.tuples import TupleConfig, TuplePool

LAP = 60


def circuit(laps: int, *, radius: float = 30, offset: float = 0.5, seed: int = 0) -> np.ndarray:
    """A drive of several laps around one circle, about 3 m between frames, with some noise; heights are noise only."""
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
    assert (pool.drive[anchors] == pool.drive[near]).all()
    assert (anchors != near).all()
    assert ((horizontal(pool, anchors, far) > 20) | (pool.drive[anchors] != pool.drive[far])).all()
    gap = np.abs(pool.frame[anchors] - pool.frame[near])
    if revisit_fraction == 1:
        assert (gap > config.revisit_gap).all()
    if revisit_fraction == 0:
        assert (gap <= config.revisit_gap).all()


def test_all_pairs_within_three_metres_are_found_and_no_other():
    config = TupleConfig(revisit_gap=LAP // 2)
    drives = [circuit(3), circuit(2, seed=1)]
    pool = TuplePool(drives, config)
    for anchor in range(5 * LAP):
        drive, frame = pool.drive[anchor], pool.frame[anchor]
        near = np.flatnonzero(np.linalg.norm((drives[drive] - drives[drive][frame])[:, :2], axis=1) < 3)
        found = [
            np.sort(group.frames[group.starts[anchor] : group.starts[anchor + 1]]) - (0 if drive == 0 else 3 * LAP)
            for group in (pool.neighbours, pool.revisits)
        ]
        same_visit = np.abs(near - frame) <= config.revisit_gap
        np.testing.assert_array_equal(found[0], near[same_visit & (near != frame)])
        np.testing.assert_array_equal(found[1], near[~same_visit])


def test_three_metres_are_too_far_for_a_positive_and_twenty_too_near_for_a_negative():
    drive = np.zeros((5, 3))
    drive[:, 0] = [0, 3, 20, np.nextafter(3, 0), np.nextafter(20, 21)]
    pool = TuplePool([drive], TupleConfig())
    np.testing.assert_array_equal(pool.neighbours.frames[: pool.neighbours.starts[1]], [3])
    np.testing.assert_array_equal(pool.far_apart(np.array(0), np.arange(5)), [False, False, False, False, True])


def test_places_of_different_drives_are_never_positives_and_always_negatives():
    config = TupleConfig(negatives=5)
    drive = circuit(1)
    pool = TuplePool([drive, drive], config)
    anchors, near, _ = columns(pool.draw(seed=0, step=0, tuples=20), config)
    assert (pool.drive[anchors] == pool.drive[near]).all()
    assert pool.far_apart(np.arange(LAP), np.arange(LAP) + LAP).all()


def test_a_batch_is_a_pure_function_of_seed_and_step():
    pool = TuplePool([circuit(3)], TupleConfig(revisit_gap=LAP // 2))
    rows = pool.draw(seed=1, step=2, tuples=4)
    np.testing.assert_array_equal(pool.draw(seed=1, step=2, tuples=4), rows)
    np.testing.assert_array_equal(TuplePool([circuit(3)], pool.config).draw(seed=1, step=2, tuples=4), rows)
    for other in ((1, 3), (2, 2), (2, 1)):
        assert (pool.draw(seed=other[0], step=other[1], tuples=4) != rows).any()


def test_half_of_the_tuples_come_from_another_visit():
    config = TupleConfig(revisit_fraction=0.5, revisit_gap=LAP // 2)
    pool = TuplePool([circuit(3)], config)
    anchors, near, _ = columns(pool.draw(seed=0, step=0, tuples=400), config)
    share = (np.abs(pool.frame[anchors] - pool.frame[near]) > config.revisit_gap).mean()
    assert 0.4 < share < 0.6


def test_without_a_revisit_the_positives_are_neighbours_and_the_other_way_round():
    config = TupleConfig(revisit_fraction=1.0)
    once = TuplePool([circuit(1)], config)
    assert len(once.draw(seed=0, step=0, tuples=5)) == 5
    sparse = np.tile(np.array([[0.0, 0, 0], [40, 0, 0]]), (40, 1))  # a place comes back only after frames elsewhere
    only_revisits = TuplePool([sparse], TupleConfig(revisit_fraction=0.0, revisit_gap=1))
    assert len(only_revisits.neighbours.anchors) == 0
    assert len(only_revisits.draw(seed=0, step=0, tuples=5)) == 5


def test_positives_and_negatives_repeat_only_where_there_are_too_few():
    drive = np.zeros((4, 3))
    drive[:, 0] = [0, 1, 50, 100]
    config = TupleConfig(positives=3, negatives=2)
    anchors, near, far = columns(TuplePool([drive], config).draw(seed=0, step=0, tuples=8), config)
    assert all(set(row) == {1 - anchor} for anchor, row in zip(anchors[:, 0], near.tolist(), strict=True))
    assert all(set(row) == {2, 3} for row in far.tolist())


def test_one_far_frame_among_many_is_found():
    drive = np.zeros((500, 3))
    drive[77, 0] = 30
    config = TupleConfig(negatives=1)
    _, _, far = columns(TuplePool([drive], config).draw(seed=0, step=0, tuples=10), config)
    assert (far == 77).all()


def test_drives_without_positives_or_negatives_are_refused():
    with pytest.raises(ValueError, match=r"no two frames lie within 3\.0 m"):
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
    assert (pool.drive[anchors[:, :1]] == pool.drive[anchors]).all()
    assert np.ptp(pool.frame[anchors[:, 0]]) > 1000
    single = TuplePool([street, street], TupleConfig(negatives=0)).draw(seed=0, step=0, tuples=40)[:, 0]
    assert (np.abs(np.diff(pool.frame[single])) > 40).mean() > 0.8


def test_a_cluster_without_another_anchor_nearby_goes_elsewhere():
    pairs = np.zeros((20, 3))
    pairs[:, 0] = np.repeat(np.arange(10) * 500.0, 2) + np.tile([0, 1], 10)
    pool = TuplePool([pairs], TupleConfig(negatives=0, cluster=2, cluster_m=0.5, revisit_gap=1))
    assert len(pool.draw(seed=0, step=0, tuples=10)) == 10
