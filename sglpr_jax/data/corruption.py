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

GAP_DEG = 0.1
"""Elevation separates the rings if no ring is wider than this angle, in degrees, and all gaps between rings are
wider."""
IN_ORDER = 0.9
"""Minimum correlation of revolution and elevation for points that are stored ring after ring."""


def ring_numbers(
    points: Float[np.ndarray, "n 3"], *, lasers: Int[np.ndarray, " n"] | None = None
) -> Int32[np.ndarray, " n"]:
    """Return the ring of every finite point, counted from 0 at the lowest elevation.

    The first of these sources that separates the rings is used:

    - `lasers`: laser numbers in any order, unless all are equal as in simulated NCLT files.
    - Elevation, if it separates all rings, as in simulated scans and for sensors with few lasers.
    - The order of the points, if they are stored ring after ring, each counter-clockwise from straight ahead, as in
      KITTI's files. There the elevation varies within a ring by more than the distance between two rings.

    Raises ValueError if no source separates the rings.
    """
    if len(points) == 0:
        return np.zeros(0, np.int32)
    elevation = np.degrees(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])))
    known = lasers is not None and lasers.min() < lasers.max()
    groups = lasers if known else _by_elevation(elevation)
    if groups is None:
        azimuth = np.arctan2(points[:, 1], points[:, 0]) % (2 * np.pi)
        groups = np.cumsum(np.diff(azimuth, prepend=0) < -np.pi)  # revolutions
        if groups[-1] == 0 or abs(np.corrcoef(groups, elevation)[0, 1]) < IN_ORDER:
            raise ValueError(
                "expected a scan with rings (laser numbers in its file, separate elevations, or points ring after ring "
                f"from straight ahead), found {len(points)} points without rings"
            )
    _, group, count = np.unique(groups, return_inverse=True, return_counts=True)
    mean = np.bincount(group, weights=elevation) / count
    return np.argsort(np.argsort(mean)).astype(np.int32)[group]


def keep_rings(rings: Int[np.ndarray, " n"], beams: int) -> Bool[np.ndarray, " n"]:
    """Whether each point remains if the sensor has only `beams` lasers: every 2nd of 64 for 32, every 4th for 16.

    The number of rings is rounded up to a power of two, because some lasers may have no returns.
    """
    sensor = 2 ** math.ceil(math.log2(int(rings.max(initial=0)) + 1))
    return rings % max(sensor // beams, 1) == 0


def _by_elevation(elevation: Float[np.ndarray, " n"]) -> Int[np.ndarray, " n"] | None:
    """Group of each point between gaps of elevation, in degrees, or None if a group is wider than `GAP_DEG`."""
    order = np.argsort(elevation)
    rising = elevation[order]
    starts = np.flatnonzero(np.diff(rising, prepend=-np.inf) > GAP_DEG)
    ends = np.append(starts[1:], len(rising)) - 1
    if (rising[ends] - rising[starts]).max() > GAP_DEG:
        return None
    groups = np.empty(len(order), np.int64)
    groups[order] = np.repeat(np.arange(len(starts)), ends - starts + 1)
    return groups


Cloud = Float32[np.ndarray, "n 3"]
Corrupt = Callable[[Cloud, float, np.random.Generator, Int[np.ndarray, " n"] | None], Cloud | Bool[np.ndarray, " n"]]
"""Function of finite points, strength, random generator and lasers if known. Returns a mask of the remaining points, or
all points at new positions."""


class Kind(NamedTuple):
    """Kind of corruption."""

    corrupt: Corrupt
    strengths: tuple[float, ...]
    """Usual strengths, from weak to strong. Only 0 for a kind without a strength."""
    limits: tuple[float, float] = (0.0, np.inf)
    """Minimum and maximum strength."""


def occlude(points: Cloud, degrees: float, rng: np.random.Generator, lasers: object) -> Bool[np.ndarray, " n"]:
    """Remove the points in a sector of the given width, in degrees, about a random heading."""
    heading, width = rng.uniform(-np.pi, np.pi), np.radians(degrees)
    azimuth = np.arctan2(points[:, 1], points[:, 0]).astype(np.float64)
    return np.abs((azimuth - heading + np.pi) % (2 * np.pi) - np.pi) >= width / 2


def remove_beams(
    points: Cloud, beams: float, rng: np.random.Generator, lasers: Int[np.ndarray, " n"] | None
) -> Bool[np.ndarray, " n"]:
    """Keep the points of a number of lasers."""
    return keep_rings(ring_numbers(points, lasers=lasers), int(beams))


def add_noise(points: Cloud, metres: float, rng: np.random.Generator, lasers: object) -> Cloud:
    """Add Gaussian noise along each ray, with the given standard deviation in metres. A point at the sensor stays."""
    distance = np.linalg.norm(points.astype(np.float64), axis=1)
    steps = metres * rng.standard_normal(len(points))
    fractions = np.divide(steps, distance, out=np.zeros_like(distance), where=distance > 0)
    return (points * (1 + fractions[:, None])).astype(np.float32)


def drop_points(points: Cloud, probability: float, rng: np.random.Generator, lasers: object) -> Bool[np.ndarray, " n"]:
    """Remove each point with this probability."""
    return rng.random(len(points)) >= probability


def offset(points: Cloud, metres: float, rng: np.random.Generator, lasers: object) -> Cloud:
    """Move the sensor to the left or to the right at random, by some metres. Occlusions stay as they are."""
    return points - np.array([0, rng.choice((-1, 1)) * metres, 0], np.float32)


def rotate_input(*_: object) -> Cloud:
    """Raise ValueError. Embedding rotates the scans, because it can rotate images, too."""
    raise ValueError("expected a corruption other than rotation; for rotation use the rotation_seed of embed")


KINDS: dict[str, Kind] = {
    "clean": Kind(lambda points, *_: points, strengths=()),
    "rotation": Kind(rotate_input, strengths=(0.0,)),
    "occlusion": Kind(occlude, strengths=(45.0, 90.0, 180.0), limits=(0.0, 360.0)),
    "beams": Kind(remove_beams, strengths=(32.0, 16.0), limits=(1.0, np.inf)),
    "noise": Kind(add_noise, strengths=(0.05, 0.1, 0.2)),
    "dropout": Kind(drop_points, strengths=(0.5, 0.9), limits=(0.0, 1.0)),
    "offset": Kind(offset, strengths=(0.5, 1.0, 2.0)),
}
"""All kinds by name."""


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


CLEAN = Corruption("clean")
ROTATION = Corruption("rotation")
CORRUPTIONS = tuple(Corruption(name, strength) for name, kind in KINDS.items() for strength in kind.strengths)
"""All kinds with their usual strengths."""


def corruption_named(name: str) -> Corruption:
    """Return the corruption of this name: a kind and, except for rotation, any strength, such as "occlusion-60"."""
    kind, _, strength = name.partition("-")
    if kind not in KINDS or bool(strength) != any(KINDS[kind].strengths):
        known = [corruption.name for corruption in CORRUPTIONS]
        nearest = difflib.get_close_matches(name, known, n=1, cutoff=0)[0]
        raise ValueError(f"expected a corruption such as {', '.join(known)}, found {name!r}; did you mean {nearest!r}?")
    try:
        return Corruption(kind, float(strength or 0))
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error


def corrupt(
    points: Cloud,
    corruption: Corruption,
    *,
    rng: np.random.Generator,
    lasers: Int[np.ndarray, " n"] | None = None,
) -> tuple[Float32[np.ndarray, "m 3"], Bool[np.ndarray, " n"]]:
    """Corrupt the finite points of a scan, in metres in the LiDAR frame. `lasers` are their lasers, if known.

    Returns the remaining points, and a mask of them among the given points.

    Raises ValueError for a rotation (see `rotation_seed` of `embed`), or if the beams cannot be separated.
    """
    result = KINDS[corruption.kind].corrupt(points, corruption.strength, rng, lasers)
    if result.dtype == bool:
        return points[result], result
    return result, np.ones(len(points), bool)


def corrupted(recording: Recording, corruption: Corruption, *, seed: int) -> Recording:
    """Return the recording with every scan corrupted on reading, as a function of `seed` and its row.

    Labels and lasers stay with their points. Points that are not finite and the times of points are removed. Raises
    ValueError for a recording of images.
    """
    if recording.has_images:
        raise ValueError(
            f"{corruption.name} needs points, found only images in sequence {recording.name}, which can only be "
            "rotated (rotation)"
        )

    def read(row: int, label_path: Path | None, lasers: bool) -> Scan:
        scan = recording.read_row(row, label_path, lasers or corruption.kind == "beams")
        with naming(scan.name), naming(corruption.name):
            finite = scan.only(np.flatnonzero(np.isfinite(scan.cloud).all(axis=1)))
            rng = np.random.default_rng((seed, row))
            points, remaining = corrupt(finite.cloud, corruption, rng=rng, lasers=finite.lasers)
            return dataclasses.replace(finite.only(remaining), points=points)

    return recording.derived(read)
