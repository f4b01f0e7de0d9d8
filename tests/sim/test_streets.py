"""From a trajectory to streets: revisits, side streets, styles, roundabouts."""

import numpy as np
import pytest
from scipy.spatial import KDTree
from town import LOOP, THERE_AND_BACK, drive

from sglpr_jax.sim.streets import (
    HIGHWAY_MPS,
    MIDDLE_M,
    SAME_STREET_M,
    Network,
    draw_streets,
    path_of,
    revisits,
    roundabouts,
)
from sglpr_jax.sim.styles import STYLES


def streets_of(corners, seed: int = 0, **how):
    path = path_of(*drive(corners, **how))
    return path, draw_streets(np.random.default_rng(seed), path)


def driven_length(streets, path) -> int:
    """Metres of the streets' middles that lie beside the path."""
    middles = np.concatenate([street.middle for street in streets])
    away, _ = KDTree(path.xy).query(middles)
    return int(np.sum(np.abs(away - MIDDLE_M) < 0.4))


@pytest.mark.parametrize("spacing", [0.2, 0.8, 3.0])
def test_a_path_has_a_point_a_metre_whatever_the_spacing(spacing):
    path = path_of(*drive(((0, 0), (60, 0), (60, 50)), spacing=spacing))
    assert np.abs(np.linalg.norm(np.diff(path.xy, axis=0), axis=1) - 1).max() < 0.1
    np.testing.assert_allclose(path.speed[10:-10], 8.0, rtol=0.05)
    np.testing.assert_allclose(path.heading[[5, -5]], [0, np.pi / 2], atol=0.02)


def test_standing_still_is_no_way():
    trajectory, times = drive(((0, 0), (60, 0)))
    standing = np.concatenate([trajectory[:30], np.tile(trajectory[29], (50, 1)), trajectory[30:]])
    path = path_of(standing, np.arange(len(standing)) * 0.1)
    np.testing.assert_allclose(path.xy, path_of(trajectory, times).xy, atol=1e-9)
    assert np.all(np.diff(path.times) > 0) and np.isfinite(path.heading).all()
    assert path.times[-1] == pytest.approx((len(standing) - 1) * 0.1)


@pytest.mark.parametrize(
    ("trajectory", "times"),
    [
        ([[0, 0], [np.nan, 1], [9, 9]], [0, 1, 2]),
        ([[0, 0], [5, 0], [9, 0]], [0, 1, 1]),
        ([[0, 0]], [0]),
        ([[0, 0], [1, 0]], [0, 1]),
    ],
)
def test_what_is_no_drive_is_refused(trajectory, times):
    with pytest.raises(ValueError, match="a trajectory needs"):
        path_of(np.array(trajectory, float), np.array(times, float))


@pytest.mark.parametrize(("corners", "again"), [(LOOP, 110), (THERE_AND_BACK, 150)])
def test_revisits_make_one_street(corners, again):
    path, streets = streets_of(corners)
    revisit = revisits(path)
    assert abs(revisit.sum() - again) < 25
    assert abs(driven_length(streets, path) - (len(path.xy) - again)) < 60
    # No two streets run along each other; where one goes on as another, they overlap by a few metres.
    network = Network(streets)
    beside: dict[tuple[int, int], set[int]] = {}
    for i, j in KDTree(network.middle).query_pairs(SAME_STREET_M - 3):
        pair = int(network.street[i]), int(network.street[j])
        if pair[0] != pair[1] and np.abs(np.cos(network.heading[i] - network.heading[j])) > 0.97:
            beside.setdefault(pair, set()).add(i)
    assert max(map(len, beside.values()), default=0) <= 14


@pytest.mark.parametrize("seed", range(5))
def test_side_streets_branch_off_and_do_not_run_along_driven_ones(seed):
    path, streets = streets_of(LOOP, seed)
    sides = [street for street in streets if KDTree(path.xy).query(street.middle)[0].max() > 8]
    assert len(sides) >= 3
    for street in sides:
        assert 20 < len(street.middle) <= 91
        away = KDTree(path.xy).query(street.middle)[0]
        assert away[:3].min() < 5 and np.median(away) > 8


def test_a_fast_drive_is_on_a_highway_and_a_slow_one_is_not():
    for speed, expected in ((HIGHWAY_MPS + 3, True), (10.0, False)):
        _, streets = streets_of(((0, 0), (900, 0)), speed=speed)
        styles = [part.sides[1].style for part in streets[0].stretches]
        assert [style is STYLES["highway"] for style in styles] == [expected] * len(styles)
        assert expected == (len(streets) == 1)  # nothing branches off a highway


def test_going_around_a_roundabout_makes_an_island():
    turn = np.linspace(-np.pi / 2, np.pi, 60)[:, None]
    circle = np.concatenate([np.cos(turn), np.sin(turn)], axis=1) * 9
    line = np.concatenate([np.arange(-60, -8)[:, None] * [0.0, 1] + [-0.0, 0], circle, np.stack(
        [np.full(50, -9.0), np.arange(-1, -51, -1.0)], axis=1)])  # fmt: skip
    path = path_of(line, np.arange(len(line)) * 0.2)
    (island,) = roundabouts(path)
    np.testing.assert_allclose(island.centre, 0, atol=1.5)
    assert 3 < island.radius < 7
    assert roundabouts(path_of(*drive(LOOP))) == ()  # crossings are none
