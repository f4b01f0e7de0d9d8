"""Which loops agree with each other: some wrong places look more alike than many right ones, but not as a whole.

Two loops and the odometry between them make a circle. Where its end is farther from its beginning than drift and the
loops' own errors explain, one of the two is wrong; the largest set in which every pair agrees is kept. After Mangelson
et al., Pairwise Consistent Measurement Set Maximization (ICRA 2018), in the plane.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from sglpr_jax.data.mounting import Mounting
from sglpr_jax.loops.loop import Loop
from sglpr_jax.loops.transforms import moved_covariance, travelled, yaw_of
from sglpr_jax.loops.upright import upright_from_lidar, upright_odometry, upright_poses

BLOCK = 64
"""Loops that are compared with all others at a time: for all at once, the numbers between take most of a gigabyte."""


@dataclasses.dataclass(frozen=True)
class ConsistencyConfig:
    """How far loops may be from agreeing."""

    neighbours: int = 3
    """A loop is looked at together with those of so many frames before it, the last one its own."""
    support: int = 2
    """So many of these, itself among them, have to show the same place."""
    frames_a_frame: float = 3.0
    """Without odometry: where queries are k frames apart, matches are apart by so many frames times k + 1, or fewer."""
    position_m: float = 0.5
    yaw_deg: float = 1.5
    """Standard deviations of the circle of two loops at one place, beside their covariances."""
    drift: float = 0.02
    """Of the odometry's position: this share of the way."""
    drift_deg_per_m: float = 0.01
    """Of its heading."""
    deviations: float = 3.0
    """Two loops agree where their circle closes within so many standard deviations."""


def agree_in_order(
    loops: Sequence[Loop], *, config: ConsistencyConfig = ConsistencyConfig()
) -> Bool[np.ndarray, "n n"]:
    """Which pairs of loops agree without odometry: the match goes on as the query does, forwards or backwards."""
    query, match = (np.array([getattr(loop, name) for loop in loops], np.int64) for name in ("query", "match"))
    on = np.abs(query[:, None] - query[None])
    return np.abs(match[:, None] - match[None]) <= config.frames_a_frame * (on + 1)


def agree(
    loops: Sequence[Loop],
    odometry: Float[np.ndarray, "n 4 4"],
    others: Sequence[Loop] | None = None,
    *,
    mounting: Mounting | None = None,
    config: ConsistencyConfig = ConsistencyConfig(),
) -> Bool[np.ndarray, "a b"]:
    """Which loops agree with which `others` (None: with each other), by the odometry of all frames.

    Loops and odometry are of LiDAR frames; `mounting` says how these are tilted, since the plane is that of the ground.
    """
    way = travelled(odometry)
    flat = _planar(upright_odometry(odometry, mounting))
    a, b = (_columns(each, flat, way, mounting) for each in (loops, loops if others is None else others))
    pairs = np.empty((len(a["query_way"]), len(b["query_way"])), bool)
    for start in range(0, len(pairs), BLOCK):
        rows = slice(start, start + BLOCK)
        pairs[rows] = _closes({name: values[rows] for name, values in a.items()}, b, config)
    return pairs


def largest_consistent_set(pairs: Bool[np.ndarray, "n n"], *, starts: int = 20) -> Int[np.ndarray, " k"]:
    """The members, in order, of a large set in which every pair agrees: greedy, from each of some likely starts.

    Finding the largest is as hard as anything; from the loop that agrees with most others, adding always the one that
    leaves most to choose from, finds it where right loops are many.
    """
    pairs = pairs & pairs.T
    degrees = pairs.sum(0)
    best = np.zeros(0, np.int64)
    for start in np.argsort(-degrees, kind="stable")[:starts]:
        members = _members_from(start, pairs, degrees)
        if len(members) > len(best):
            best = np.array(members)
        if len(best) > pairs.shape[0] / 2:
            break
    return np.sort(best)


def _members_from(start: np.int64, pairs: Bool[np.ndarray, "n n"], degrees: Int[np.ndarray, " n"]) -> list[np.int64]:
    """One consistent set, greedy from `start`; `degrees` says of each loop with how many it agrees."""
    members, chosen, left = [], start, np.ones(len(pairs), bool)
    while True:
        members.append(chosen)
        stay = left & pairs[chosen]
        stay[chosen] = False
        # Each loop leaves once, so that to keep the degrees costs no more than to take them once.
        degrees = degrees - pairs[left & ~stay].sum(0)
        left = stay
        if not left.any():
            return members
        chosen = np.argmax(np.where(left, degrees, -1))


Planar = Float[np.ndarray, "... 3"]
"""Poses in the plane: x, y, yaw."""


def _columns(
    loops: Sequence[Loop], flat: Planar, way: Float[np.ndarray, " n"], mounting: Mounting | None
) -> dict[str, np.ndarray]:
    query, match = (np.array([getattr(loop, name) for loop in loops], np.int64) for name in ("query", "match"))
    poses = np.array([loop.match_from_query for loop in loops]).reshape(-1, 4, 4)
    covariances = np.array([loop.covariance for loop in loops]).reshape(-1, 6, 6)
    covariances = moved_covariance(covariances, upright_from_lidar(mounting))
    return {
        "pose": _planar(upright_poses(poses, mounting)),
        "query_pose": flat[query],
        "match_pose": flat[match],
        "query_way": way[query],
        "match_way": way[match],
        "place": covariances[:, 0, 0] + covariances[:, 1, 1],
        "turn": covariances[:, 5, 5],
    }


def _closes(a: dict[str, np.ndarray], b: dict[str, np.ndarray], config: ConsistencyConfig) -> Bool[np.ndarray, "a b"]:
    """Whether the circle of each loop of a and each of b closes, of their `_columns`."""
    # From a's query by odometry to b's query, by loop b to b's match, by odometry to a's match: that is loop a again.
    query_from_query = _relative(a["query_pose"][:, None], b["query_pose"][None])
    match_from_match = _relative(a["match_pose"][:, None], b["match_pose"][None])
    around = _compose(match_from_match, _compose(b["pose"][None], _inverse(query_from_query)))
    apart = _relative(a["pose"][:, None], around)
    length = np.abs(a["query_way"][:, None] - b["query_way"]) + np.abs(a["match_way"][:, None] - b["match_way"])
    lever = np.hypot(query_from_query[..., 0], query_from_query[..., 1])
    turn = np.radians(config.yaw_deg) ** 2 + a["turn"][:, None] + b["turn"][None]
    turn = turn + (np.radians(config.drift_deg_per_m) * length) ** 2
    place = config.position_m**2 + a["place"][:, None] + b["place"][None] + (config.drift * length) ** 2
    place = place + turn * lever**2
    close = apart[..., 0] ** 2 + apart[..., 1] ** 2 <= config.deviations**2 * place
    return close & (np.abs(apart[..., 2]) <= config.deviations * np.sqrt(turn))


def _planar(poses: Float[np.ndarray, "n 4 4"]) -> Planar:
    return np.concatenate([poses[:, :2, 3], yaw_of(poses)[:, None]], axis=1)


def _compose(a: Planar, b: Planar) -> Planar:
    """a_from_c of a_from_b and b_from_c."""
    a, b = np.broadcast_arrays(a, b)
    cos, sin = np.cos(a[..., 2]), np.sin(a[..., 2])
    x = a[..., 0] + cos * b[..., 0] - sin * b[..., 1]
    y = a[..., 1] + sin * b[..., 0] + cos * b[..., 1]
    return np.stack([x, y, _wrapped(a[..., 2] + b[..., 2])], axis=-1)


def _inverse(a: Planar) -> Planar:
    cos, sin = np.cos(a[..., 2]), np.sin(a[..., 2])
    return np.stack([-cos * a[..., 0] - sin * a[..., 1], sin * a[..., 0] - cos * a[..., 1], -a[..., 2]], axis=-1)


def _relative(a: Planar, b: Planar) -> Planar:
    """a_from_b of two poses in one frame."""
    return _compose(_inverse(a), b)


def _wrapped(angle: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    return (angle + np.pi) % (2 * np.pi) - np.pi
