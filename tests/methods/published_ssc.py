"""SSC as its authors published it, on the points themselves: every pair of scans takes a walk over all of them."""

import math

import numpy as np

PRIORITY = {9: 10, 10: 11, 11: 12, 12: 13, 13: 15, 14: 16, 15: 14, 16: 17, 17: 9, 18: 18, 19: 19}
LANDMARKS = (13, 14, 16, 18, 19)


def cells_of(points, classes, *, rings=50, nearest=0.0, sectors=360, farthest=50.0):
    """Of every cell the greatest priority of a class in it; 0: none."""
    ring = np.floor((np.hypot(*points.T[:2]) - nearest) / ((farthest - nearest) / rings))
    sector = sector_of(points, sectors)
    cells = np.zeros((rings, sectors), int)
    for category, priority in sorted(PRIORITY.items(), key=lambda item: item[1]):
        chosen = (classes == category) & (ring >= 0) & (ring < rings) & (sector < sectors)
        cells[ring[chosen].astype(int), sector[chosen]] = priority
    return cells


def sector_of(points, sectors=360):
    return np.floor((math.pi + np.arctan2(points[:, 1], points[:, 0])) / (2 * math.pi / sectors)).astype(int)


def outline_of(points, classes):
    """Of every sector x and y of the landmark that comes last; 0: none."""
    outline = np.zeros((2, 360))
    for row, sector in enumerate(sector_of(points.astype(float))):
        if classes[row] in LANDMARKS and sector < 360:
            outline[:, sector] = points[row, :2]
    return outline


def shift_of(query, other):
    """The sectors by which the ranges of the one are turned against those of the other."""
    ranges, others = np.hypot(*query), np.hypot(*other)
    return int(np.argmin([np.abs(ranges - np.roll(others, -s)).sum() for s in range(360)]))


def rotate(points, degrees):
    """x and y after a turn counter-clockwise."""
    turned = (points[0] + 1j * points[1]) * np.exp(1j * np.radians(degrees))
    return np.stack([turned.real, turned.imag])


def move_of(query, turned):
    """The move of the turned outline, whose sectors are in the order of the query's."""
    fixed, landmarks = query.T.tolist(), turned.T.tolist()
    move, count, step = [0.0, 0.0], 0, [1.0, 1.0]
    while count < 100 and max(map(abs, step)) >= 1e-5:
        total, pairs = [0.0, 0.0], 1
        for j in range(360):
            partners = [landmarks[k % 360] for k in range(j - 10, j + 10) if any(landmarks[k % 360])]
            if not any(fixed[j]) or not partners:
                continue
            apart = [[fixed[j][a] - partner[a] - move[a] for a in (0, 1)] for partner in partners]
            x, y = min(apart, key=lambda d: d[0] ** 2 + d[1] ** 2)
            if abs(x) < 3 and abs(y) < 3:
                total, pairs = [total[0] + x, total[1] + y], pairs + 1
        step = [value / pairs for value in total]
        move, count = [move[0] + step[0], move[1] + step[1]], count + 1
    return np.array(move)


def alignment(query, other):
    """The shift, and the move after it: none where it would be beyond 5 m."""
    shift = shift_of(query, other)
    move = move_of(query, np.roll(rotate(other, -shift), -shift, axis=1))
    return shift, move if np.all(np.abs(move) <= 5) else np.zeros(2)


def distance(query, other, *, rings=50, nearest=0.0, moved=lambda scan: scan):
    """1 - the share of equal cells among those occupied in either: query and other are points and classes.

    `moved` says which points and classes of the other are moved.
    """
    shift, move = alignment(outline_of(*query), outline_of(*other))
    points, classes = moved(other)
    there = (rotate(points[:, :2].astype(float).T, -shift) + move[:, None]).T
    a = cells_of(query[0].astype(float), query[1], rings=rings, nearest=nearest)
    b = cells_of(there, classes, rings=rings, nearest=nearest)
    either = (a > 0) | (b > 0)
    return 1 - np.sum(either & (a == b)) / either.sum()
