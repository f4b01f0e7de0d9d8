import numpy as np
import pytest

from sglpr_jax.methods.handcrafted.ring import ring, ring_distance, sinogram


def occupied_cells(points):
    """Centres of the occupied cells within the circle, in cells of 140 m / 120, point by point."""
    found = set()
    for x, y, z in points.astype(float):
        u, v = int(np.floor((x + 70) / 140 * 120)), int(np.floor((y + 70) / 140 * 120))
        if -1 < z < 10 and 0 <= u < 120 and 0 <= v < 120 and np.hypot(u - 59.5, v - 59.5) < 59.5:
            found.add((u - 59.5, v - 59.5))
    return sorted(found)


def radon(points, angles):
    """The Radon transform from its definition, cell by cell."""
    lines = np.zeros((angles, 120))
    for x, y in occupied_cells(points):
        for a in range(angles):
            place = x * np.cos(np.radians(3 * a)) + y * np.sin(np.radians(3 * a)) + 59.5
            low = int(np.floor(place))
            lines[a, low] += 1 - (place - low)
            if low < 119:
                lines[a, low + 1] += place - low
    return lines


def published_score(a, b):
    """The published comparison without its absolute values: spectra (120, 120) standardised, correlated over angles."""
    a, b = ((x - x.mean()) / x.std() for x in (a, b))
    return max(np.sum(a * np.roll(b, shift, axis=0)) for shift in range(120)) / 120**2


@pytest.fixture(scope="module")
def rows(places):
    return np.stack([ring(points) for points, _ in places])


def test_the_transform_is_the_sum_along_lines(places):
    rng = np.random.default_rng(0)
    wide = np.column_stack([rng.uniform(-80, 80, (500, 2)), rng.uniform(-3, 12, 500)]).astype(np.float32)
    for points in (places[0][0][::4], wide):
        np.testing.assert_allclose(sinogram(points), radon(points, 60), atol=1e-9)


def test_each_angle_counts_every_cell_once(places):
    sums = sinogram(places[0][0]).sum(axis=1)
    np.testing.assert_allclose(sums, len(occupied_cells(places[0][0])))


def test_angles_beyond_180_degrees_are_reversed_rows(places):
    whole = sinogram(places[0][0], angles=120)
    np.testing.assert_allclose(whole[60:], whole[:60, ::-1], atol=1e-9)


def test_the_descriptor_is_the_magnitude_of_the_spectrum(places):
    points = places[1][0]
    full = np.abs(np.fft.fft(sinogram(points), axis=1)) / np.sqrt(120)
    np.testing.assert_allclose(ring(points).reshape(60, 61), full[:, :61], rtol=1e-5, atol=1e-5)


def test_the_distance_is_one_minus_the_correlation_of_the_whole_spectra(places, rows):
    whole = [np.abs(np.fft.fft(sinogram(points, angles=120), axis=1)) for points, _ in places]
    expected = [[1 - published_score(a, b) for b in whole] for a in whole]
    np.testing.assert_allclose(ring_distance(rows, rows), expected, atol=1e-5)


def test_whole_angles_of_turn_change_nothing(places, rows):
    """A turn by 3 degrees rolls the sinogram by a row. Beyond 180 degrees the rows return reversed."""
    lines = sinogram(places[0][0])
    turned = []
    for shift in range(60):
        rolled = np.concatenate([lines[60 - shift :, ::-1], lines[: 60 - shift]])
        turned.append(np.abs(np.fft.rfft(rolled, norm="ortho")).ravel())
    found = ring_distance(np.stack(turned).astype(np.float32), rows)
    np.testing.assert_allclose(found, np.tile(ring_distance(rows[:1], rows), (60, 1)), atol=1e-5)


@pytest.mark.parametrize("degrees", [90, 180, 270])
def test_quarter_turns_of_the_points_change_nothing(places, rows, turn_points, degrees):
    turned = np.stack([ring(turn_points(points, np.radians(degrees))) for points, _ in places])
    assert np.diag(ring_distance(turned, rows)).max() < 1e-3  # points on borders of cells may move


@pytest.mark.parametrize("degrees", [3, 33, 150])
def test_other_turns_of_the_points_change_little(places, rows, turn_points, degrees):
    turned = np.stack([ring(turn_points(points, np.radians(degrees))) for points, _ in places])
    between = ring_distance(rows, rows)[~np.eye(len(rows), dtype=bool)]
    assert np.diag(ring_distance(turned, rows)).max() < 0.25 * between.min()


def test_a_move_by_whole_cells_changes_nothing():
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-30, 30, (300, 2)), np.zeros(300)]).astype(np.float32)
    moved = points + np.array([7 * 7 / 6, -4 * 7 / 6, 0], np.float32)
    assert ring_distance(ring(points)[None], ring(moved)[None])[0, 0] < 2e-3


def test_an_empty_scan_has_nothing_in_common_with_any(rows):
    np.testing.assert_array_equal(ring_distance(np.zeros((1, 3660), np.float32), rows), 1)
