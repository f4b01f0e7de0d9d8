"""Eleven routes through a lattice of streets, with revisits as in the KITTI sequences of the same names.

A route is a walk over the crossings of the lattice. It becomes a line: crossings are moved at random, streets are bent,
and corners are rounded. A street that is driven twice has the same line both times.
"""

import dataclasses
from collections import Counter, defaultdict
from itertools import pairwise
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d

from sglpr_jax.se3 import lengths_along

STEP_M = 0.5  # distance between two points of a route's line, in metres
BLOCKS_PER_LOOP = 12  # minimum number of streets for each loop of a route
ROUNDABOUT_RADIUS_M = 10.0
SHORTEST_LOOP = {False: 6, True: 4}  # minimum number of streets between two visits, by `Role.opposite`: at least 30 s
TRIES, TRIES_PER_LOOP = 100, 30  # maximum number of attempts to draw a walk, and a loop of it

Revisit = Literal["none", "same", "opposite"]
REVISITS: tuple[Revisit, ...] = ("none", "same", "opposite")
Line = Float[np.ndarray, "_ 2"]
"""Points of a line in the plane, in metres."""
Node = tuple[int, int]
"""Crossing of the lattice: column and row."""
STEPS = ((1, 0), (0, 1), (-1, 0), (0, -1))  # from a crossing to its four neighbours


@dataclasses.dataclass(frozen=True)
class Role:
    """Parameters of the drive along a route."""

    speed_mps: float
    """Approximate mean speed, in m/s. The vehicle is faster on free streets and slower in corners."""
    again: float = 0.0  # fraction of the streets that are driven a second time
    opposite: bool = False  # whether the second visit is in the opposite direction
    loops: int = 1
    """Maximum number of times that the route returns to streets driven before. With 1, it ends after this return."""
    straight: float = 0.5  # probability of driving straight ahead at a crossing
    block_m: float = 60.0  # distance between neighbouring crossings of the lattice, in metres
    winding: float = 0.2
    """Maximum shift of a crossing, and twice the maximum bend of a street, as fractions of `block_m`."""
    corner_m: float = 9.0
    """Standard deviation of the Gaussian that rounds corners, in metres. Corners have about this radius."""
    roundabouts: float = 0.08  # fraction of the crossings that are roundabouts

    @property
    def revisit(self) -> Revisit:
        """Direction of the revisits, as `simulate_repeating` names it."""
        return "none" if not self.again else "opposite" if self.opposite else "same"


ROLES = {
    "00": Role(8.2, again=0.25, loops=20),
    "01": Role(19.0, straight=1.0, winding=0.3, block_m=150.0, corner_m=40.0, roundabouts=0.0),
    "02": Role(9.5, again=0.15, loops=4, straight=0.6),
    "03": Role(7.5, straight=0.7),
    "04": Role(12.0, straight=1.0, winding=0.04, corner_m=20.0, roundabouts=0.0),
    "05": Role(8.0, again=0.25, loops=20),
    "06": Role(9.5, again=0.25, straight=0.85, winding=0.1, roundabouts=0.0),
    "07": Role(7.0, again=0.12),
    "08": Role(8.0, again=0.25, opposite=True, loops=20, roundabouts=0.04),
    "09": Role(9.5, again=0.07, straight=0.6),
    "10": Role(8.0, straight=0.6),
}
"""Routes by name.

As in KITTI, 00, 02, 05, 06 and 07 revisit places in the same direction, 08 in the opposite direction, and 09 at its
very end. 01 (a highway), 03, 04 (a straight road) and 10 have no revisits. Where KITTI has few revisits, the routes
have more.
"""


def plan_route(rng: np.random.Generator, role: Role, *, blocks: int, days: int = 1) -> Float[np.ndarray, "n 2"]:
    """Returns the middle line of the streets of a drive of about `blocks` blocks a day, with a point every STEP_M."""
    walk = plan_days(rng, role, blocks=blocks, days=days)
    corners = resampled(_line(rng, role, np.array(walk)), STEP_M)
    return resampled(gaussian_filter1d(corners, role.corner_m / STEP_M, axis=0, mode="nearest"), STEP_M)


def resampled(line: Float[np.ndarray, "n 2"], step_m: float) -> Float[np.ndarray, "m 2"]:
    """Resamples a line to points about `step_m` metres apart."""
    length = lengths_along(line)
    even_lengths = np.linspace(0, length[-1], max(2, round(length[-1] / step_m) + 1))
    return np.stack([np.interp(even_lengths, length, axis) for axis in line.T], axis=1)


def plan_walk(rng: np.random.Generator, role: Role, *, blocks: int) -> list[Node]:
    """Returns the crossings along a route of `blocks` streets, plus or minus one street for each loop.

    Raises:
      ValueError: `blocks` is too small for a loop.
    """
    if role.again == 0:  # a walk that never goes west and therefore never meets itself
        walk, heading = [(0, 0)], (1, 0)
        for _ in range(blocks):
            if rng.random() >= role.straight:
                heading = (1, 0) if heading[0] == 0 else (0, int(rng.choice([-1, 1])))
            walk.append(_neighbour(walk[-1], heading))
        return walk
    loops = min(role.loops, max(1, blocks // BLOCKS_PER_LOOP))
    blocks_of_loops = np.diff(np.linspace(0, blocks, loops + 1).round().astype(int)).tolist()
    for _ in range(TRIES):
        if walk := _walk_in_loops(rng, role, blocks_of_loops):
            return walk
    raise ValueError(f"no walk of {blocks} blocks with {loops} loops was found; a loop needs 8 blocks or more")


def plan_days(rng: np.random.Generator, role: Role, *, blocks: int, days: int) -> list[Node]:
    """Returns a walk `days` times as long as one of `plan_walk`, along the same streets.

    Each later day begins with a U-turn at a roundabout, and takes the streets driven least often in its direction.
    """
    walk = plan_walk(rng, role, blocks=blocks)
    neighbours = defaultdict(set)
    for a, b in pairwise(walk):
        neighbours[a].add(b)
        neighbours[b].add(a)
    drive_count = Counter(pairwise(walk))
    for step in range(blocks * (days - 1)):
        crossing, previous = walk[-1], walk[-2]
        is_start_of_day = step % blocks == 0
        choices = [] if is_start_of_day else sorted(neighbours[crossing] - {previous})
        # The fraction decides at random among streets that were driven equally often.
        counts = [drive_count[crossing, node] + rng.random() for node in choices]
        walk.append(choices[np.argmin(counts)] if choices else previous)  # without choices: a U-turn
        drive_count[crossing, walk[-1]] += 1
    return walk


def _walk_in_loops(rng: np.random.Generator, role: Role, blocks_of_loops: list[int]) -> list[Node]:
    """Draws a walk of several loops with about these numbers of streets. Returns [] at a dead end."""
    walk = [(0, 0)]
    for blocks in blocks_of_loops:
        again = max(1, round(role.again * blocks))
        attempts = (_with_loop(rng, role, walk, new=blocks - again, again=again) for _ in range(TRIES_PER_LOOP))
        walk = next(filter(None, attempts), [])
        if not walk:
            break
    return walk


def _with_loop(rng: np.random.Generator, role: Role, nodes: list[Node], *, new: int, again: int) -> list[Node]:
    """Extends `nodes` by `new` streets to an earlier crossing, then by `again` streets that were driven once before.

    Returns [] if there is no such loop.
    """
    wandering = int(rng.integers(new // 2, max(new - 1, 1) + 1))
    walk = _with_new_crossings(rng, role, nodes, wandering)
    returning = new - wandering
    paths = _paths_back(walk, returning + 1) if walk else {}
    shortest_loop = max(SHORTEST_LOOP[role.opposite], new // 2)
    drive_count = Counter(_streets(walk))
    closed_walks = []
    for k, node in enumerate(walk):
        path = paths.get(node, [])
        loop_streets = len(walk) - 1 + len(path) - k
        if len(path) < max(returning - 1, 1) or loop_streets < shortest_loop:
            continue
        revisited = walk[max(k - again, 0) : k + 1][::-1] if role.opposite else walk[k : k + again + 1]
        if len(revisited) == again + 1 and all(drive_count[street] == 1 for street in _streets(revisited)):
            closed_walks.append(walk + path + revisited[1:])
    return closed_walks[rng.integers(len(closed_walks))] if closed_walks else []


def _with_new_crossings(rng: np.random.Generator, role: Role, nodes: list[Node], steps: int) -> list[Node]:
    """Extends `nodes` by `steps` random unvisited crossings. Returns [] at a dead end."""
    walk, visited = list(nodes), set(nodes)
    for _ in range(steps):
        heading = (1, 0)
        if len(walk) > 1:
            heading = (walk[-1][0] - walk[-2][0], walk[-1][1] - walk[-2][1])
        choices = [step for step in STEPS if _neighbour(walk[-1], step) not in visited]
        if not choices:
            return []
        # If straight on is free, it has about the probability `role.straight`. The .01 avoids weights of 0.
        weights = np.array([role.straight if step == heading else (1.01 - role.straight) / 2 for step in choices])
        walk.append(_neighbour(walk[-1], choices[rng.choice(len(choices), p=weights / weights.sum())]))
        visited.add(walk[-1])
    return walk


def _paths_back(walk: list[Node], longest: int) -> dict[Node, list[Node]]:
    """Shortest paths of up to `longest` streets from the end of `walk`, over unvisited crossings to visited ones.

    The key of a path is its last crossing.
    """
    visited, reached = set(walk), set(walk)
    frontier: dict[Node, list[Node]] = {walk[-1]: []}
    paths: dict[Node, list[Node]] = {}
    for _ in range(longest):  # breadth-first search
        next_frontier = {}
        for end, path in frontier.items():
            for node in (_neighbour(end, step) for step in STEPS):
                if node in visited:
                    paths.setdefault(node, [*path, node])
                elif node not in reached:
                    next_frontier[node] = [*path, node]
                    reached.add(node)
        frontier = next_frontier
    return paths


def _streets(walk: list[Node]) -> list[tuple[Node, Node]]:
    """Streets of a walk, as pairs of crossings in ascending order, which are equal for both directions."""
    return [(min(a, b), max(a, b)) for a, b in pairwise(walk)]


def _neighbour(node: Node, step: Node) -> Node:
    return node[0] + step[0], node[1] + step[1]


def _line(rng: np.random.Generator, role: Role, walk: np.ndarray) -> Line:
    """Line along a walk with sharp corners. Roundabouts are driven counter-clockwise."""
    low, high = walk.min(axis=0), walk.max(axis=0)
    columns, rows = high - low + 1
    lattice = np.stack(np.meshgrid(np.arange(columns), np.arange(rows), indexing="ij"), axis=-1)
    jitter = rng.uniform(-role.winding, role.winding, (columns, rows, 2))
    crossing = (lattice + jitter) * role.block_m
    bend = rng.uniform(-role.winding, role.winding, (2, columns, rows)) / 2  # of streets along x and along y
    is_roundabout = rng.random((columns, rows)) < role.roundabouts
    nodes: list[Node] = [(int(column), int(row)) for column, row in walk - low]
    for previous, node, following in zip(nodes[:-2], nodes[1:-1], nodes[2:], strict=True):
        is_roundabout[node] |= previous == following  # the vehicle makes a U-turn here
    parts = []
    for start, end in pairwise(nodes):
        first, last = sorted((start, end))  # the street has the same line in both directions
        axis = 0 if last[0] > first[0] else 1
        street = _parabola(crossing[first], crossing[last], bend[axis][first])
        if start != first:
            street = street[::-1]
        for node in (start, end):
            if is_roundabout[node]:
                street = street[np.linalg.norm(street - crossing[node], axis=1) > ROUNDABOUT_RADIUS_M]
        if parts and is_roundabout[start]:
            parts.append(_roundabout_arc(crossing[start], parts[-1][-1], street[0]))
        parts.append(street)
    return np.concatenate(parts)


def _parabola(start: Float[np.ndarray, "2"], end: Float[np.ndarray, "2"], bend: float) -> Line:
    """Street from one crossing to its neighbour. Its end tangents meet `bend` times its length to the left."""
    tangent_point = (start + end) / 2 + bend * np.array([start[1] - end[1], end[0] - start[0]])
    t = np.linspace(0, 1, 60)[:, None]
    return (1 - t) ** 2 * start + 2 * t * (1 - t) * tangent_point + t**2 * end


def _roundabout_arc(
    centre: Float[np.ndarray, "2"], entry: Float[np.ndarray, "2"], exit: Float[np.ndarray, "2"]
) -> Line:
    """Counter-clockwise arc around a roundabout. If entry and exit are the same point, it is a full circle."""
    first, last = (np.arctan2(*(point - centre)[::-1]) for point in (entry, exit))
    angle = first + np.linspace(0, (last - first) % (2 * np.pi) or 2 * np.pi, 30)
    return centre + ROUNDABOUT_RADIUS_M * np.stack([np.cos(angle), np.sin(angle)], axis=1)
