"""Handcrafted methods from their definitions, point by point: descriptors, and distances of two descriptors."""

import math
from collections import defaultdict

import numpy as np


def scan_context(points):
    """The maximum height above 2 m below the sensor in 20 rings x 60 sectors, whose outer borders belong to them."""
    found = np.full((20, 60), -np.inf)
    for x, y, z in points.tolist():
        radius, degrees = math.hypot(x, y), math.degrees(math.atan2(y, x)) % 360
        cell = max(math.ceil(radius / 4), 1) - 1, max(math.ceil(degrees / 6), 1) - 1
        if radius <= 80:
            found[cell] = max(found[cell], z + 2)
    return np.where(np.isfinite(found), found, 0)


def scan_context_distance(query, other):
    """Equations 6 and 7, column by column."""
    best = 1.0
    for shift in range(60):
        pairs = zip(query.reshape(20, 60).T, np.roll(other.reshape(20, 60), -shift, axis=1).T, strict=True)
        cosines = [a @ b / np.linalg.norm(a) / np.linalg.norm(b) for a, b in pairs if a.any() and b.any()]
        best = min(best, 1 - np.mean(cosines)) if cosines else best
    return best


def lidar_iris(points):
    """80 rings x 360 degrees with a bit for each of eight elevations."""
    image = np.zeros((80, 360), int)
    for x, y, z in points.tolist():
        radius = math.hypot(x, y)
        column = min(math.floor(180 + math.degrees(math.atan2(y, x)) + 0.5), 359)
        bit = math.floor((math.degrees(math.atan2(z, radius)) + 24) / 4)
        image[min(math.floor(radius), 79), column] |= 2 ** min(max(bit, 0), 7)
    return image


def m2dp_signature(points):
    """The paper's matrix A: plane by plane, point by point."""
    centred = points.astype(np.float64) - points.mean(axis=0, dtype=np.float64)
    _, _, axes = np.linalg.svd(centred, full_matrices=False)
    first, second = (axis * (1 if np.sum((centred @ axis) ** 3) >= 0 else -1) for axis in axes[:2])
    cloud = centred @ np.stack([first, second, np.cross(first, second)], axis=1)
    edges = np.linspace(0, math.sqrt(max(np.linalg.norm(cloud, axis=1))), 9) ** 2
    edges[-1] += 0.001
    rows = []
    for azimuth in np.linspace(-math.pi / 2, math.pi / 2, 4):
        for elevation in np.linspace(0, math.pi / 2, 16):
            flat = math.cos(elevation)
            normal = np.array([flat * math.cos(azimuth), flat * math.sin(azimuth), math.sin(elevation)])
            x_axis = np.array([1.0, 0, 0]) - normal[0] * normal
            y_axis = np.cross(normal, x_axis)
            counts = np.zeros((8, 16))
            for point in cloud:
                x, y = point @ x_axis, point @ y_axis
                ring = max(k for k in range(8) if math.hypot(x, y) >= edges[k])
                counts[ring, min(int((math.atan2(y, x) + math.pi) / (2 * math.pi) * 16), 15)] += 1
            rows.append(counts.ravel() / len(cloud))
    return np.array(rows)


def m2dp(points):
    """The first singular vectors of the signature, by power iteration."""
    a, right = m2dp_signature(points), np.ones(128)
    for _ in range(200):
        left = a @ right / np.linalg.norm(a @ right)
        right = a.T @ left / np.linalg.norm(a.T @ left)
    return np.concatenate([left, right])


def solid(points):
    """Counts of voxels in 40 ranges x 32 elevations, weighted by those of each elevation."""
    voxels = defaultdict(list)
    for point in points.astype(np.float64):
        if 3 <= math.sqrt(np.sum(point**2)) <= 80:
            voxels[tuple(np.floor(point.astype(np.float32) / np.float32(0.4)).astype(int))].append(point)
    counts = np.zeros((40, 32))
    for members in voxels.values():
        x, y, z = np.mean(members, axis=0)
        radius = math.hypot(x, y)
        elevation = math.floor((math.degrees(math.atan2(z, radius)) + 24.8) / 26.8 * 32)
        counts[min(int(radius / 2), 39), min(max(elevation, 0), 31)] += 1
    number = counts.sum(axis=0)
    weighted = counts @ ((number - number.min()) / (number.max() - number.min()))
    return weighted / np.linalg.norm(weighted)


def sinogram(points):
    """The Radon transform of the occupied cells of 140 m / 120 within the circle, cell by cell."""
    cells = set()
    for x, y, z in points.astype(float):
        u, v = int(np.floor((x + 70) / 140 * 120)), int(np.floor((y + 70) / 140 * 120))
        if -1 < z < 10 and 0 <= u < 120 and 0 <= v < 120 and np.hypot(u - 59.5, v - 59.5) < 59.5:
            cells.add((u - 59.5, v - 59.5))
    lines = np.zeros((60, 121))
    for x, y in sorted(cells):
        for a in range(60):
            place = x * np.cos(np.radians(3 * a)) + y * np.sin(np.radians(3 * a)) + 59.5
            low = int(np.floor(place))
            lines[a, low] += 1 - (place - low)
            lines[a, low + 1] += place - low
    return lines[:, :120]


def ring(points):
    """Magnitudes of the spectra of the lines."""
    return (np.abs(np.fft.fft(sinogram(points), axis=1)) / np.sqrt(120))[:, :61]


def ring_distance(a, b):
    """The published comparison without its absolute values: spectra (120, 120) standardised, correlated over angles."""
    halves = (np.concatenate([x, x[:, 59:0:-1]], axis=1) for x in (a.reshape(60, 61), b.reshape(60, 61)))
    whole = [np.concatenate([x, x]) for x in halves]  # beyond 180 degrees the lines are reversed
    a, b = ((x - x.mean()) / x.std() for x in whole)
    return 1 - max(np.sum(a * np.roll(b, shift, axis=0)) for shift in range(120)) / 120**2


def probe(points):
    """The greatest height above the ground in 40 rings x 60 sectors."""
    heights = np.zeros((40, 60))
    for x, y, z in points.astype(float):
        radius = math.hypot(x, y)
        if radius < 80 and z + 1.73 > 0.3:
            cell = int(radius / 2), int(math.degrees(math.atan2(y, x)) % 360 // 6) % 60
            heights[cell] = max(heights[cell], z + 1.73)
    return heights


def probe_distance(a, b):
    """Jaccard index of the probabilities and cosine of the heights, ring by ring."""
    a, b = (x.reshape(40, 60).astype(float) for x in (a, b))
    cosines = [np.sum(a * np.roll(b, -s, axis=1)) / np.linalg.norm(a) / np.linalg.norm(b) for s in range(60)]
    b = np.roll(b, -int(np.argmax(cosines)), axis=1)
    agreed = either = 0.0
    for r in range(40):
        deviation = 2.0 / (2 * r + 1)
        kernel = np.exp(-((np.radians([6 * min(s, 60 - s) for s in range(60)]) / deviation) ** 2) / 2)
        p, q = (
            [sum((x[r, t] > 0) * kernel[(s - t) % 60] for t in range(60)) / kernel.sum() for s in range(60)]
            for x in (a, b)
        )
        u = min(deviation, 1)
        s, t = (np.clip((1 - u) * np.array(x) + u / 2, 0.01, 0.99) for x in (p, q))
        divergence = sum(x * np.log(x / y) + (1 - x) * np.log((1 - x) / (1 - y)) for x, y in ((s, t), (t, s)))
        union = math.exp(-math.degrees(deviation) / 6) * np.maximum(p, q)
        agreed, either = agreed + np.sum(union * np.exp(-divergence)), either + union.sum()
    return 1 - max(cosines) * agreed / either


def polar_fft(image, radius):
    """Logarithms of the sums in 20 rings x 60 sectors, and their lowest frequencies."""
    sums = np.zeros((20, 60))
    for row, column in np.ndindex(*image.shape):
        down, right = row - (image.shape[0] - 1) / 2, column - (image.shape[1] - 1) / 2
        distance = math.hypot(down, right)
        if distance < radius:
            turn = math.atan2(down, right) / (2 * math.pi) % 1.0
            sums[int(distance / radius * 20), int(turn * 60) % 60] += 25.5 * image[row, column]
    waves = np.exp(-2j * np.pi * np.outer(np.arange(60), np.arange(16)) / 60)
    spectrum = np.abs(np.log(1 + sums) @ waves).ravel()
    return spectrum / np.linalg.norm(spectrum)
