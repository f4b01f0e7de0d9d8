"""Corruptions of scans for robustness tests: occlusion, fewer beams, noise, dropout and a moved sensor."""

import dataclasses
import difflib
import math
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int32

from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scan import Scan
from sglpr_jax.files import naming
from sglpr_jax.se3 import wrap_angle

GAP_DEG = 0.1
"""Maximum width of a ring and minimum gap between rings, in degrees of elevation, if elevation separates the rings."""
IN_ORDER = 0.9
"""Minimum correlation between the number of the revolution and the elevation, if points are stored ring after ring."""


def ring_numbers(
    points: Float[np.ndarray, "n 3"], *, lasers: Int[np.ndarray, " n"] | None = None
) -> Int32[np.ndarray, " n"]:
    """Return the ring of each of some finite points (x, y, z in metres), counted from 0 at the lowest elevation.

    The first of these sources that separates the rings is used:

    - `lasers`: laser numbers in any order, unless all are equal as in simulated NCLT files.
    - Elevation, if it separates all rings, as in simulated scans and for sensors with few lasers.
    - The order of the points, if they are stored ring after ring, each counter-clockwise from straight ahead, as in
      KITTI's files, where the rings overlap in elevation.

    Raises ValueError if no source separates the rings.
    """
    if len(points) == 0:
        return np.zeros(0, np.int32)
    elevation = np.degrees(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])))
    has_lasers = lasers is not None and lasers.min() < lasers.max()
    groups = lasers if has_lasers else _groups_by_elevation(elevation)
    if groups is None:
        azimuth = np.arctan2(points[:, 1], points[:, 0]) % (2 * np.pi)
        groups = np.cumsum(np.diff(azimuth, prepend=0) < -np.pi)  # a new revolution starts where the azimuth drops
        if groups[-1] == 0 or abs(np.corrcoef(groups, elevation)[0, 1]) < IN_ORDER:
            raise ValueError(
                "expected a scan with rings (laser numbers in its file, separate elevations, or points ring after ring "
                f"from straight ahead), found {len(points)} points without rings"
            )
    _, group, counts = np.unique(groups, return_inverse=True, return_counts=True)
    mean_elevation = np.bincount(group, weights=elevation) / counts
    rank_of_group = np.argsort(np.argsort(mean_elevation)).astype(np.int32)
    return rank_of_group[group]


def is_on_kept_ring(rings: Int[np.ndarray, " n"], beams: int) -> Bool[np.ndarray, " n"]:
    """Whether each point remains if only `beams` lasers are kept: every 2nd of 64 for 32 lasers, every 4th for 16.

    The number of rings is rounded up to a power of two, because some lasers may have no returns.
    """
    lasers = 2 ** math.ceil(math.log2(int(rings.max(initial=0)) + 1))
    return rings % max(lasers // beams, 1) == 0


def _groups_by_elevation(elevation: Float[np.ndarray, " n"]) -> Int[np.ndarray, " n"] | None:
    """Group of each point between gaps of elevation, in degrees, or None if a group is wider than `GAP_DEG`."""
    order = np.argsort(elevation)
    sorted_elevation = elevation[order]
    starts = np.flatnonzero(np.diff(sorted_elevation, prepend=-np.inf) > GAP_DEG)
    ends = np.append(starts[1:], len(sorted_elevation)) - 1
    if (sorted_elevation[ends] - sorted_elevation[starts]).max() > GAP_DEG:
        return None
    groups = np.empty(len(order), np.int64)
    groups[order] = np.repeat(np.arange(len(starts)), ends - starts + 1)
    return groups


Cloud = Float32[np.ndarray, "n 3"]
Lasers = Int[np.ndarray, " n"] | None
Corrupt = Callable[[Cloud, float, np.random.Generator, Lasers], Cloud | Bool[np.ndarray, " n"]]
"""Function of finite points (n, 3), strength, random generator and laser numbers, if known. It returns either a mask of
the points that remain, or all points at new positions."""


class Kind(NamedTuple):
    """Kind of corruption."""

    corrupt: Corrupt
    strengths: tuple[float, ...]
    """Usual strengths, from weak to strong. Only 0, or none, for a kind without a strength."""
    limits: tuple[float, float] = (0.0, np.inf)
    """Minimum and maximum strength."""


def occlude(points: Cloud, degrees: float, rng: np.random.Generator, lasers: object) -> Bool[np.ndarray, " n"]:
    """Return a mask of the points outside a sector `degrees` wide about a random heading."""
    heading = rng.uniform(-np.pi, np.pi)
    azimuth = np.arctan2(points[:, 1], points[:, 0]).astype(np.float64)
    return np.abs(wrap_angle(azimuth - heading)) >= np.radians(degrees) / 2


def remove_beams(points: Cloud, beams: float, rng: np.random.Generator, lasers: Lasers) -> Bool[np.ndarray, " n"]:
    """Return a mask of the points of evenly spaced lasers, `beams` in number."""
    return is_on_kept_ring(ring_numbers(points, lasers=lasers), int(beams))


def add_noise(points: Cloud, metres: float, rng: np.random.Generator, lasers: object) -> Cloud:
    """Add Gaussian noise of standard deviation `metres` to the range of each point. A point at the sensor stays."""
    ranges = np.linalg.norm(points.astype(np.float64), axis=1)
    errors_m = metres * rng.standard_normal(len(points))
    relative_errors = np.divide(errors_m, ranges, out=np.zeros_like(ranges), where=ranges > 0)
    return (points * (1 + relative_errors[:, None])).astype(np.float32)


def drop_points(points: Cloud, probability: float, rng: np.random.Generator, lasers: object) -> Bool[np.ndarray, " n"]:
    """Return a mask that removes each point with this probability."""
    return rng.random(len(points)) >= probability


def move_sensor(points: Cloud, metres: float, rng: np.random.Generator, lasers: object) -> Cloud:
    """Move the sensor by `metres` to the left or right, at random. No point appears or disappears behind another."""
    return points - np.array([0, rng.choice((-1, 1)) * metres, 0], np.float32)


def reject_rotation(*_: object) -> Cloud:
    """Raise ValueError: `embed` applies the corruption "rotation" itself, because it can rotate images, too."""
    raise ValueError("expected a corruption other than rotation; for rotation use the rotation_seed of embed")


KINDS: dict[str, Kind] = {
    "clean": Kind(lambda points, *_: points, strengths=()),
    "rotation": Kind(reject_rotation, strengths=(0.0,)),
    "occlusion": Kind(occlude, strengths=(45.0, 90.0, 180.0), limits=(0.0, 360.0)),
    "beams": Kind(remove_beams, strengths=(32.0, 16.0), limits=(1.0, np.inf)),
    "noise": Kind(add_noise, strengths=(0.05, 0.1, 0.2)),
    "dropout": Kind(drop_points, strengths=(0.5, 0.9), limits=(0.0, 1.0)),
    "offset": Kind(move_sensor, strengths=(0.5, 1.0, 2.0)),
}
"""All kinds by name. Strengths are degrees (occlusion), lasers (beams), metres (noise, offset), or a probability."""


@dataclasses.dataclass(frozen=True)
class Corruption:
    """Corruption of every scan of a recording: a kind of `KINDS` and a strength in its unit."""

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


ROTATION = Corruption("rotation")
CORRUPTIONS = tuple(Corruption(name, strength) for name, kind in KINDS.items() for strength in kind.strengths)
"""All kinds with their usual strengths."""


def corruption_named(name: str) -> Corruption:
    """Return the corruption of a name: a kind of `KINDS` and, if the kind has one, a strength, as in "occlusion-60".

    Raises ValueError, with the most similar name, if the kind or the strength is invalid.
    """
    kind, _, strength = name.partition("-")
    if kind not in KINDS or bool(strength) != any(KINDS[kind].strengths):  # "clean" and "rotation" have no strength
        known = [corruption.name for corruption in CORRUPTIONS]
        nearest = difflib.get_close_matches(name, known, n=1, cutoff=0)[0]
        raise ValueError(f"expected a corruption such as {', '.join(known)}, found {name!r}; did you mean {nearest!r}?")
    with naming(name):
        return Corruption(kind, float(strength or 0))


def corrupt(
    points: Cloud, corruption: Corruption, *, rng: np.random.Generator, lasers: Lasers = None
) -> tuple[Float32[np.ndarray, "m 3"], Bool[np.ndarray, " n"]]:
    """Corrupt the finite points of a scan, in metres in the LiDAR frame. `lasers` are their laser numbers, if known.

    Returns the corrupted points that remain, and a mask of their rows in `points`.

    Raises ValueError for a rotation (see `rotation_seed` of `embed`), or if the beams cannot be separated.
    """
    mask_or_moved = KINDS[corruption.kind].corrupt(points, corruption.strength, rng, lasers)
    if mask_or_moved.dtype == bool:
        return points[mask_or_moved], mask_or_moved
    return mask_or_moved, np.ones(len(points), bool)


def corrupted(recording: Recording, corruption: Corruption, *, seed: int) -> Recording:
    """Return the recording with every scan corrupted when it is read. Equal seeds and rows give equal scans.

    Labels and lasers stay with their points. Points that are not finite and the times of points are removed. Raises
    ValueError for a recording of images.
    """
    if recording.has_images:
        raise ValueError(
            f"{corruption.name} needs points, found only images in sequence {recording.name}, which can only be "
            "rotated (rotation)"
        )

    def read(row: int, label_path: Path | None) -> Scan:
        scan = recording.read_row(row, label_path)
        with naming(scan.name), naming(corruption.name):
            finite = scan.only(np.flatnonzero(np.isfinite(scan.cloud).all(axis=1)))
            rng = np.random.default_rng((seed, row))
            points, remaining = corrupt(finite.cloud, corruption, rng=rng, lasers=finite.lasers)
            return dataclasses.replace(finite.only(remaining), points=points)

    return recording.with_reader(read, options={f"corruption {corruption.name}": str(seed)})
