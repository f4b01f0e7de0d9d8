"""What can go wrong with a scan, by name and strength: pure functions on clouds.

Points are metres in the LiDAR frame: x forward, y left, z up. All functions keep the order of the points.
"""

import dataclasses
import difflib
from collections.abc import Sequence as Many
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from sglpr_jax.data.rings import keep_rings, ring_numbers

Kind = Literal["clean", "rotation", "occlusion", "beams", "noise", "dropout", "offset"]
_UNITS = {"occlusion": "°", "noise": " m", "offset": " m"}
_LIMITS = {"occlusion": (0, 360), "beams": (1, np.inf), "dropout": (0, 1)}


@dataclasses.dataclass(frozen=True)
class Disturbance:
    """What happens to every scan of a sequence, and how much of it; see `disturb` for the meaning of `strength`.

    Raises ValueError for a strength that the kind cannot have.
    """

    kind: Kind
    strength: float = 0.0

    def __post_init__(self):
        low, high = _LIMITS.get(self.kind, (0, np.inf))
        if not low <= self.strength <= high:
            raise ValueError(f"expected {self.kind} of a strength from {low:g} to {high:g}, found {self.strength:g}")

    @property
    def name(self) -> str:
        """As a command line takes it: "occlusion-90"."""
        return f"{self.kind}-{self.strength:g}" if self.strength else self.kind

    @property
    def label(self) -> str:
        """The strength with its unit; the name where there is none."""
        return f"{self.strength:g}{_UNITS.get(self.kind, '')}" if self.strength else self.kind


CLEAN = Disturbance("clean")
ROTATION = Disturbance("rotation")
DISTURBANCES = (
    ROTATION,
    *(Disturbance("occlusion", degrees) for degrees in (45.0, 90.0, 180.0)),
    *(Disturbance("beams", beams) for beams in (32.0, 16.0)),
    *(Disturbance("noise", metres) for metres in (0.05, 0.1, 0.2)),
    *(Disturbance("dropout", share) for share in (0.5, 0.9)),
    *(Disturbance("offset", metres) for metres in (0.5, 1.0, 2.0)),
)
"""Those of `bin/stress`, weak to strong."""


def chosen_disturbances(names: Many[str]) -> tuple[Disturbance, ...]:
    """The disturbances of these names; a kind stands for all its strengths, and no name at all for everything.

    Raises ValueError, with the nearest name, where there is no such disturbance.
    """
    known = {disturbance.name: disturbance for disturbance in DISTURBANCES}
    kinds = {disturbance.kind for disturbance in DISTURBANCES}
    for name in names:
        if name not in known and name not in kinds:
            nearest = difflib.get_close_matches(name, [*known, *kinds], n=1, cutoff=0)[0]
            raise ValueError(f"no disturbance {name!r}; did you mean {nearest!r}? There are {', '.join(known)}")
    return tuple(d for d in DISTURBANCES if not names or d.name in names or d.kind in names)


def disturb(
    points: Float32[np.ndarray, "n 3"],
    disturbance: Disturbance,
    *,
    rng: np.random.Generator,
    lasers: Int[np.ndarray, " n"] | None = None,
) -> tuple[Float32[np.ndarray, "m 3"], Bool[np.ndarray, " n"]]:
    """The points that are left, and which of the finite points given they are.

    By kind, the strength is: occlusion, the width in degrees of a sector without points, about a random heading; beams,
    how many lasers are left (`rings.keep_rings`); dropout, the share of points lost; noise, the standard deviation in
    metres along the ray; offset, how many metres to a random side the scanner stands. Rotation is not done here: it is
    `rotation_seed` of `retrieval.embed`, which turns images too. Raises ValueError for it, and where beams cannot be
    told apart.
    """
    kept = np.ones(len(points), bool)
    match disturbance.kind:
        case "occlusion":
            kept = outside_sector(points, heading=rng.uniform(-np.pi, np.pi), width=np.radians(disturbance.strength))
        case "beams":
            kept = keep_rings(ring_numbers(points, lasers=lasers), int(disturbance.strength))
        case "dropout":
            kept = rng.random(len(points)) >= disturbance.strength
        case "noise":
            points = add_to_range(points, disturbance.strength * rng.standard_normal(len(points)))
        case "offset":
            points = moved_left(points, rng.choice((-1, 1)) * disturbance.strength)
        case "rotation":
            raise ValueError("expected a disturbance other than rotation, which is the rotation_seed of embedding")
    return points[kept], kept


def outside_sector(points: Float[np.ndarray, "n 3"], *, heading: float, width: float) -> Bool[np.ndarray, " n"]:
    """Whether each point lies outside a sector `width` radians wide about `heading` (0: ahead, counter-clockwise)."""
    azimuth = np.arctan2(points[:, 1], points[:, 0]).astype(np.float64)
    return np.abs((azimuth - heading + np.pi) % (2 * np.pi) - np.pi) >= width / 2


def add_to_range(points: Float32[np.ndarray, "n 3"], metres: Float[np.ndarray, " n"]) -> Float32[np.ndarray, "n 3"]:
    """Move every point along its ray, away from the sensor; a point at the sensor stays, for it has no ray."""
    distance = np.linalg.norm(points.astype(np.float64), axis=1)
    share = np.divide(metres, distance, out=np.zeros_like(distance), where=distance > 0)
    return (points * (1 + share[:, None])).astype(np.float32)


def moved_left(points: Float32[np.ndarray, "n 3"], offset_m: float) -> Float32[np.ndarray, "n 3"]:
    """The scan about a place `offset_m` to the left of the scanner; negative: to the right.

    The points move, what they hide does not: a scanner over there would see behind some things and not others, and one
    scan cannot tell what.
    """
    return points - np.array([0, offset_m, 0], np.float32)
