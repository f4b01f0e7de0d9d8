import math

import numpy as np
import pytest

from sglpr_jax.methods.handcrafted.lidar_iris import lidar_iris, lidar_iris_distance, responses


def in_loops(points):
    """The image from its definition, point by point."""
    image = np.zeros((80, 360), int)
    for x, y, z in points.tolist():
        radius = math.hypot(x, y)
        if radius >= 80:
            continue
        column = math.floor(math.degrees(math.atan2(y, x)) % 360) % 360
        bit = math.floor((math.degrees(math.atan2(z, radius)) + 24) / 4)
        image[math.floor(radius), column] |= 2 ** min(max(bit, 0), 7)
    return image


def response_in_loops(row, wavelength):
    """One ring's log-Gabor response, as the sum over the positive frequencies."""
    columns = np.arange(360)
    response = np.zeros(360, complex)
    for k in range(1, 180):
        gain = math.exp(-(math.log(k / 360 * wavelength) ** 2) / (2 * math.log(0.75) ** 2))
        amplitude = np.sum(row * np.exp(-2j * math.pi * k * columns / 360))
        response += gain * amplitude * np.exp(2j * math.pi * k * columns / 360) / 360
    return response


def alignment_in_loops(query, other):
    """The shift at the peak of the phase correlation, from the whole cross-power spectrum summed over the rings."""
    a, b = np.fft.fft(query), np.fft.fft(other)
    cross = np.zeros(360, complex)
    for ring in range(80):
        product = a[ring].conj() * b[ring]
        size = np.abs(a[ring]) * np.abs(b[ring])
        cross += np.where(size > 1e-6, product / np.maximum(size, 1e-6), 0)
    return int(np.argmax(np.fft.ifft(cross).real))


def distance_in_loops(query, other):
    """The least Hamming distance over the ten shifts, on arrays of bits."""
    bits, faint = [], []
    for image in (query, other):
        found = responses(image.astype(np.float64))
        bits.append(np.stack([found.real > 0, found.imag > 0]))
        faint.append(np.stack([np.abs(found) < 1e-4] * 2))
    shift, best = alignment_in_loops(query, other), 1.0
    for turn in (0, 180):
        for step in (-2, -1, 0, 1, 2):
            other_bits, other_faint = (np.roll(x[1], -(shift + step + turn), axis=-1) for x in (bits, faint))
            clear = ~(faint[0] | other_faint)
            if clear.any():
                best = min(best, np.sum((bits[0] != other_bits) & clear) / np.sum(clear))
    return best


def test_the_image_has_a_bit_for_every_height_with_a_point(places):
    rng = np.random.default_rng(0)
    wide = np.column_stack([rng.uniform(-70, 70, (2000, 2)), rng.uniform(-30, 30, 2000)]).astype(np.float32)
    for points in (places[0][0], wide):
        np.testing.assert_array_equal(lidar_iris(points).reshape(80, 360), in_loops(points))


@pytest.mark.parametrize(("filter_", "wavelength"), [(0, 18.0), (1, 28.8), (2, 46.08), (3, 73.728)])
def test_the_filters_are_log_gabor(places, filter_, wavelength):
    image = lidar_iris(places[0][0]).reshape(80, 360).astype(np.float64)
    for ring in (7, 30):
        expected = response_in_loops(image[ring], wavelength)
        np.testing.assert_allclose(responses(image)[filter_, ring], expected, atol=1e-8)


def test_the_distance_is_the_hamming_distance_of_the_signs(places, turn_points):
    images = [lidar_iris(points) for points, _ in places[:3]]
    images.append(lidar_iris(turn_points(places[0][0], 2.0)))
    images.append(np.zeros(28800, np.float32))
    rows = np.stack(images)
    expected = [[distance_in_loops(a.reshape(80, 360), b.reshape(80, 360)) for b in rows] for a in rows[:3]]
    np.testing.assert_allclose(lidar_iris_distance(rows[:3], rows), expected, atol=1e-5)
    assert expected[0][-1] == 1


def test_whole_degrees_of_turn_change_nothing(places):
    rows = np.stack([lidar_iris(points) for points, _ in places])
    turned = np.roll(rows.reshape(-1, 80, 360), 137, axis=2).reshape(rows.shape)
    np.testing.assert_allclose(np.diag(lidar_iris_distance(turned, rows)), 0, atol=1e-3)
