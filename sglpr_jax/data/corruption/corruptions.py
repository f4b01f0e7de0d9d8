"""What can go wrong with a scan, by name and strength: pure functions on clouds.

`KINDS` is the table: a new kind is a function and its entry there, and its strengths are in `bin/stress`. Points are
metres in the LiDAR frame: x forward, y left, z up. All functions keep the order of the points.
"""

import dataclasses
import difflib
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from sglpr_jax.data.corruption.laser_rings import keep_rings, ring_numbers

Cloud = Float32[np.ndarray, "n 3"]


@dataclasses.dataclass(frozen=True)
class Scan:
    """What a corruption is given: the finite points of one scan, where known the laser of each, and what draws."""

    points: Cloud
    lasers: Int[np.ndarray, " n"] | None
    rng: np.random.Generator


@dataclasses.dataclass(frozen=True)
class Kind:
    """A kind of corruption."""

    corrupt: Callable[[Scan, float], Cloud | Bool[np.ndarray, " n"]]
    """Of a scan and the strength: which points are left, as flags, or all points at other places."""
    strengths: tuple[float, ...]
    """Those of `bin/stress`, weak to strong."""
    unit: str = ""
    limits: tuple[float, float] = (0.0, np.inf)
    """The least and the largest strength."""
    needs_lasers: bool = False
    """Whether it is to be told which laser each point is from."""


def occlude(scan: Scan, degrees: float) -> Bool[np.ndarray, " n"]:
    """No points in a sector so many degrees wide, about a random heading."""
    return outside_sector(scan.points, heading=scan.rng.uniform(-np.pi, np.pi), width=np.radians(degrees))


def fewer_beams(scan: Scan, beams: float) -> Bool[np.ndarray, " n"]:
    """So many of the sensor's lasers are left (`laser_rings.keep_rings`). ValueError where none tells the rings."""
    return keep_rings(ring_numbers(scan.points, lasers=scan.lasers), int(beams))


def add_noise(scan: Scan, metres: float) -> Cloud:
    """Gaussian noise along the ray, of this standard deviation."""
    return add_to_range(scan.points, metres * scan.rng.standard_normal(len(scan.points)))


def drop_out(scan: Scan, share: float) -> Bool[np.ndarray, " n"]:
    """Each point is lost with this probability."""
    return scan.rng.random(len(scan.points)) >= share


def offset(scan: Scan, metres: float) -> Cloud:
    """The scan as from so many metres to a random side."""
    return moved_left(scan.points, scan.rng.choice((-1, 1)) * metres)


def leave(scan: Scan, strength: float) -> Cloud:
    """Nothing happens."""
    return scan.points


def rotate_elsewhere(scan: Scan, strength: float) -> Cloud:
    """Rotation is not done on points: embedding rotates images too."""
    raise ValueError("expected a corruption other than rotation, which is the rotation_seed of embedding")


KINDS: dict[str, Kind] = {
    "clean": Kind(leave, strengths=()),
    "rotation": Kind(rotate_elsewhere, strengths=(0.0,)),
    "occlusion": Kind(occlude, strengths=(45.0, 90.0, 180.0), unit="°", limits=(0.0, 360.0)),
    "beams": Kind(fewer_beams, strengths=(32.0, 16.0), limits=(1.0, np.inf), needs_lasers=True),
    "noise": Kind(add_noise, strengths=(0.05, 0.1, 0.2), unit=" m"),
    "dropout": Kind(drop_out, strengths=(0.5, 0.9), limits=(0.0, 1.0)),
    "offset": Kind(offset, strengths=(0.5, 1.0, 2.0), unit=" m"),
}
"""Every kind by its name."""


@dataclasses.dataclass(frozen=True)
class Corruption:
    """What happens to every scan of a recording, and how much of it: a kind of `KINDS` and a strength in its unit.

    Raises ValueError for an unknown kind and for a strength that the kind cannot have.
    """

    kind: str
    strength: float = 0.0

    def __post_init__(self):
        if self.kind not in KINDS:
            raise ValueError(f"expected a kind of corruption among {', '.join(KINDS)}, found {self.kind!r}")
        low, high = KINDS[self.kind].limits
        if not low <= self.strength <= high:
            raise ValueError(f"expected {self.kind} of a strength from {low:g} to {high:g}, found {self.strength:g}")

    @property
    def name(self) -> str:
        """As a command line takes it: "occlusion-90"."""
        return f"{self.kind}-{self.strength:g}" if self.strength else self.kind

    @property
    def label(self) -> str:
        """The strength with its unit; the name where there is none."""
        return f"{self.strength:g}{KINDS[self.kind].unit}" if self.strength else self.kind

    @property
    def needs_lasers(self) -> bool:
        """Whether `corrupt` is to be told the lasers."""
        return KINDS[self.kind].needs_lasers


CLEAN = Corruption("clean")
ROTATION = Corruption("rotation")
CORRUPTIONS = tuple(Corruption(name, strength) for name, kind in KINDS.items() for strength in kind.strengths)
"""Those of `bin/stress`."""


def chosen_corruptions(names: Sequence[str]) -> tuple[Corruption, ...]:
    """The corruptions of these names; a kind stands for all its strengths, and no name at all for everything.

    Raises ValueError, with the nearest name, where there is no such corruption.
    """
    known = {corruption.name: corruption for corruption in CORRUPTIONS}
    kinds = {corruption.kind for corruption in CORRUPTIONS}
    for name in names:
        if name not in known and name not in kinds:
            nearest = difflib.get_close_matches(name, [*known, *kinds], n=1, cutoff=0)[0]
            raise ValueError(f"no corruption {name!r}; did you mean {nearest!r}? There are {', '.join(known)}")
    return tuple(each for each in CORRUPTIONS if not names or each.name in names or each.kind in names)


def corrupt(
    points: Cloud,
    corruption: Corruption,
    *,
    rng: np.random.Generator,
    lasers: Int[np.ndarray, " n"] | None = None,
) -> tuple[Float32[np.ndarray, "m 3"], Bool[np.ndarray, " n"]]:
    """The points that are left, and which of the finite `points` given they are.

    Raises ValueError for rotation, which is the `rotation_seed` of embedding, and where beams cannot be told apart.
    """
    found = KINDS[corruption.kind].corrupt(Scan(points, lasers, rng), corruption.strength)
    if found.dtype == bool:
        return points[found], found
    return found, np.ones(len(points), bool)


def outside_sector(points: Float[np.ndarray, "n 3"], *, heading: float, width: float) -> Bool[np.ndarray, " n"]:
    """Whether each point lies outside a sector `width` radians wide about `heading` (0: ahead, counter-clockwise)."""
    azimuth = np.arctan2(points[:, 1], points[:, 0]).astype(np.float64)
    return np.abs((azimuth - heading + np.pi) % (2 * np.pi) - np.pi) >= width / 2


def add_to_range(points: Cloud, metres: Float[np.ndarray, " n"]) -> Cloud:
    """Move every point along its ray, away from the sensor; a point at the sensor stays, for it has no ray."""
    distance = np.linalg.norm(points.astype(np.float64), axis=1)
    share = np.divide(metres, distance, out=np.zeros_like(distance), where=distance > 0)
    return (points * (1 + share[:, None])).astype(np.float32)


def moved_left(points: Cloud, offset_m: float) -> Cloud:
    """The scan about a place `offset_m` to the left of the scanner; negative: to the right.

    The points move, what they hide does not: a scanner over there would see behind some things and not others, and one
    scan cannot tell what.
    """
    return points - np.array([0, offset_m, 0], np.float32)
