"""LiDAR Iris' comparison of two images as its authors published it, with plain numpy in place of OpenCV."""

import math

import numpy as np

ROWS, COLUMNS = 80, 360


def sample(image, down, right):
    """The image between its pixels, by the four about each place; 0 outside."""
    padded = np.pad(image, 1)
    down, right = np.clip(down, -1, ROWS) + 1, np.clip(right, -1, COLUMNS) + 1
    i, j = np.minimum(np.floor(down), ROWS).astype(int), np.minimum(np.floor(right), COLUMNS).astype(int)
    a, b = down - i, right - j
    above = (1 - b) * padded[i, j] + b * padded[i, j + 1]
    below = (1 - b) * padded[i + 1, j] + b * padded[i + 1, j + 1]
    return (1 - a) * above + a * below


def moved_by(a, b):
    """How far down and right `a` lies from `b`, by phase correlation; the centre of mass of 5 x 5 about the peak."""
    cross = np.fft.fft2(a) * np.fft.fft2(b).conj()
    weight = np.abs(cross) ** 2 / (np.abs(cross) ** 2 + 2.0**-23)
    surface = np.fft.fftshift(np.fft.ifft2(weight * np.exp(1j * np.angle(cross))).real)
    top, left = np.unravel_index(np.argmax(surface), surface.shape)
    total = down = right = 0.0
    for i in range(max(top - 2, 0), min(top + 3, ROWS)):
        for j in range(max(left - 2, 0), min(left + 3, COLUMNS)):
            total, down, right = total + surface[i, j], down + i * surface[i, j], right + j * surface[i, j]
    total = total or 1.0
    return ROWS / 2 - down / total, COLUMNS / 2 - right / total


def log_polar(image):
    """The spectrum's amplitudes without the low frequencies, by angle (half a turn) and logarithm of the radius."""
    amplitudes = np.fft.fftshift(np.abs(np.fft.fft2(image))) / image.size
    low = np.outer(*(np.cos(np.pi * (np.arange(size) / size - 0.5)) for size in image.shape))
    angle = math.pi / 2 + math.pi * np.arange(ROWS)[:, None] / ROWS
    radius = math.hypot(ROWS / 2, COLUMNS / 2) ** (np.arange(COLUMNS)[None, :] / COLUMNS)
    filtered = amplitudes * (1 - low) * (2 - low)
    return sample(filtered, ROWS / 2 + radius * np.cos(angle), COLUMNS / 2 + radius * np.sin(angle))


def turn_and_scale(query, other):
    down, right = moved_by(log_polar(query), log_polar(other))
    angle, scale = math.pi * down / ROWS, math.hypot(ROWS / 2, COLUMNS / 2) ** (right / COLUMNS)
    return (-angle, 1 / scale) if scale > 1.8 else (angle, scale)


def turned_and_scaled(image, angle, scale):
    """The image turned by `angle` about its middle, `scale` times smaller."""
    down, right = np.mgrid[-ROWS // 2 : ROWS // 2, -COLUMNS // 2 : COLUMNS // 2]
    back = (right + 1j * down) * scale * np.exp(1j * angle)
    return sample(image, ROWS / 2 + back.imag, COLUMNS / 2 + back.real)


def shift_of(query, other):
    """By how many whole columns to roll the query to the right so that it lies on the other."""
    query, other = query / 255, other / 255
    return int(moved_by(turned_and_scaled(query, *turn_and_scale(query, other)), other)[1])


def signs(image):
    """The bits of the log-Gabor responses, and which are too faint; the inverse transform is not divided by 360."""
    frequency = np.arange(1, 181) / 360
    bits, faint = [], []
    for wavelength in (18.0, 28.8, 46.08, 73.728):
        gain = np.zeros(360)
        gain[1:181] = np.exp(-(np.log(frequency * wavelength) ** 2) / (2 * math.log(0.75) ** 2))
        response = np.fft.ifft(np.fft.fft(image) * gain) * 360
        bits.append(np.stack([response.real > 0, response.imag > 0]))
        faint.append(np.stack([np.abs(response) < 1e-4] * 2))
    return np.stack(bits), np.stack(faint)


def least_hamming(query, other, shift):
    (a, m), (b, n) = signs(query), signs(other)
    best = 1.0
    for s in range(shift - 2, shift + 3):
        clear = ~(np.roll(m, s, axis=-1) | n)
        if clear.any():
            best = min(best, np.sum((np.roll(a, s, axis=-1) != b) & clear) / np.sum(clear))
    return best


def distance(query, other):
    """The smaller of the distances from two alignments: to the other, and to the other rolled by half its columns."""
    opposite = np.roll(other, 180, axis=1)
    return min(least_hamming(query, image, shift_of(query, image)) for image in (other, opposite))
