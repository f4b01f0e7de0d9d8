"""Corruptions of a scan, by kind and strength, as pure functions of point clouds.

`KINDS` lists the kinds. A new kind needs a function and an entry there, and `bin/stress` then includes its strengths.
Points are in metres in the LiDAR frame: x forward, y left, z up. All functions keep the order of the points.
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
    """Input of a corruption: the finite points of one scan, the laser of each point if known, and a random
    generator."""

    points: Cloud
    lasers: Int[np.ndarray, " n"] | None
    rng: np.random.Generator


@dataclasses.dataclass(frozen=True)
class Kind:
    """Kind of corruption."""

    corrupt: Callable[[Scan, float], Cloud | Bool[np.ndarray, " n"]]
    """Function of the scan and the strength. It returns a mask of the remaining points, or all points at new
    positions."""
    strengths: tuple[float, ...]
    """Strengths that `bin/stress` uses, from weak to strong."""
    unit: str = ""
    """Unit of the strength."""
    limits: tuple[float, float] = (0.0, np.inf)
    """Minimum and maximum strength."""
    needs_lasers: bool = False
    """Whether `corrupt` needs the laser of each point."""


def occlude(scan: Scan, degrees: float) -> Bool[np.ndarray, " n"]:
    """Remove the points in a sector of the given width, in degrees, about a random heading."""
    return outside_sector(scan.points, heading=scan.rng.uniform(-np.pi, np.pi), width=np.radians(degrees))


def fewer_beams(scan: Scan, beams: float) -> Bool[np.ndarray, " n"]:
    """Keep the given number of lasers (`laser_rings.keep_rings`). Raises ValueError if the rings are unknown."""
    return keep_rings(ring_numbers(scan.points, lasers=scan.lasers), int(beams))


def add_noise(scan: Scan, metres: float) -> Cloud:
    """Add Gaussian noise along each ray, with the given standard deviation in metres."""
    return add_to_range(scan.points, metres * scan.rng.standard_normal(len(scan.points)))


def drop_out(scan: Scan, share: float) -> Bool[np.ndarray, " n"]:
    """Remove each point with the given probability."""
    return scan.rng.random(len(scan.points)) >= share


def offset(scan: Scan, metres: float) -> Cloud:
    """Move the sensor by the given distance, in metres, to the left or to the right at random."""
    return moved_left(scan.points, scan.rng.choice((-1, 1)) * metres)


def leave(scan: Scan, strength: float) -> Cloud:
    """Return the points unchanged."""
    return scan.points


def rotate_elsewhere(scan: Scan, strength: float) -> Cloud:
    """Raise ValueError. Embedding rotates the scans, because it can rotate images, too."""
    raise ValueError("expected a corruption other than rotation; for rotation use the rotation_seed of embed")


KINDS: dict[str, Kind] = {
    "clean": Kind(leave, strengths=()),
    "rotation": Kind(rotate_elsewhere, strengths=(0.0,)),
    "occlusion": Kind(occlude, strengths=(45.0, 90.0, 180.0), unit="°", limits=(0.0, 360.0)),
    "beams": Kind(fewer_beams, strengths=(32.0, 16.0), limits=(1.0, np.inf), needs_lasers=True),
    "noise": Kind(add_noise, strengths=(0.05, 0.1, 0.2), unit=" m"),
    "dropout": Kind(drop_out, strengths=(0.5, 0.9), limits=(0.0, 1.0)),
    "offset": Kind(offset, strengths=(0.5, 1.0, 2.0), unit=" m"),
}
"""All kinds by name."""


@dataclasses.dataclass(frozen=True)
class Corruption:
    """Corruption of every scan of a recording: a kind of `KINDS` and a strength in its unit.

    Raises ValueError if the kind is unknown or the strength is outside its limits.
    """

    kind: str
    strength: float = 0.0

    def __post_init__(self):
        if self.kind not in KINDS:
            raise ValueError(f"expected a kind of corruption among {', '.join(KINDS)}, found {self.kind!r}")
        low, high = KINDS[self.kind].limits
        if not low <= self.strength <= high:
            raise ValueError(f"expected {self.kind} with a strength from {low:g} to {high:g}, found {self.strength:g}")

    @property
    def name(self) -> str:
        """Name on the command line: "occlusion-90"."""
        return f"{self.kind}-{self.strength:g}" if self.strength else self.kind

    @property
    def label(self) -> str:
        """Strength with its unit, or the name of the kind if it has no strength."""
        return f"{self.strength:g}{KINDS[self.kind].unit}" if self.strength else self.kind

    @property
    def needs_lasers(self) -> bool:
        """Whether `corrupt` needs the laser of each point."""
        return KINDS[self.kind].needs_lasers


CLEAN = Corruption("clean")
ROTATION = Corruption("rotation")
CORRUPTIONS = tuple(Corruption(name, strength) for name, kind in KINDS.items() for strength in kind.strengths)
"""All corruptions of `bin/stress`."""


def chosen_corruptions(names: Sequence[str]) -> tuple[Corruption, ...]:
    """Return the corruptions with the given names. A kind selects all its strengths. Without names, all corruptions are
    returned.

    Raises:
      ValueError: If a name is unknown. The message contains the nearest name.
    """
    known = {corruption.name: corruption for corruption in CORRUPTIONS}
    kinds = {corruption.kind for corruption in CORRUPTIONS}
    for name in names:
        if name not in known and name not in kinds:
            nearest = difflib.get_close_matches(name, [*known, *kinds], n=1, cutoff=0)[0]
            raise ValueError(
                f"expected a corruption, found {name!r}; did you mean {nearest!r}? Available: {', '.join(known)}"
            )
    return tuple(each for each in CORRUPTIONS if not names or each.name in names or each.kind in names)


def corrupt(
    points: Cloud,
    corruption: Corruption,
    *,
    rng: np.random.Generator,
    lasers: Int[np.ndarray, " n"] | None = None,
) -> tuple[Float32[np.ndarray, "m 3"], Bool[np.ndarray, " n"]]:
    """Corrupt the finite points of a scan.

    Arguments:
      points: Finite points in the LiDAR frame, in metres.
      corruption: Kind and strength.
      rng: Random generator.
      lasers: Laser of each point, if known.

    Returns:
      The remaining points, and a mask of them among the given points.

    Raises:
      ValueError: If the corruption is a rotation (see `rotation_seed` of `embed`), or if the beams cannot be separated.
    """
    found = KINDS[corruption.kind].corrupt(Scan(points, lasers, rng), corruption.strength)
    if found.dtype == bool:
        return points[found], found
    return found, np.ones(len(points), bool)


def outside_sector(points: Float[np.ndarray, "n 3"], *, heading: float, width: float) -> Bool[np.ndarray, " n"]:
    """Return whether each point is outside a sector of `width` radians about `heading` (0: ahead,
    counter-clockwise)."""
    azimuth = np.arctan2(points[:, 1], points[:, 0]).astype(np.float64)
    return np.abs((azimuth - heading + np.pi) % (2 * np.pi) - np.pi) >= width / 2


def add_to_range(points: Cloud, metres: Float[np.ndarray, " n"]) -> Cloud:
    """Move every point along its ray, away from the sensor. A point at the sensor has no ray and stays."""
    distance = np.linalg.norm(points.astype(np.float64), axis=1)
    share = np.divide(metres, distance, out=np.zeros_like(distance), where=distance > 0)
    return (points * (1 + share[:, None])).astype(np.float32)


def moved_left(points: Cloud, offset_m: float) -> Cloud:
    """Return the scan relative to a place `offset_m` metres to the left of the sensor, or to the right if negative.

    Only the points move. A sensor at the new place would see other occlusions, which one scan does not show.
    """
    return points - np.array([0, offset_m, 0], np.float32)
