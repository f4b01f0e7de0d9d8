"""Sequences of disturbed scans: any method embeds them as it does the originals."""

import dataclasses

import numpy as np
from jaxtyping import Float32, Int, Int32

from sglpr_jax.data.disturbances import Disturbance, disturb
from sglpr_jax.data.sequence import Drive, ImageSequence, ScanSequence


@dataclasses.dataclass(frozen=True, eq=False)
class DisturbedSequence(ScanSequence):
    """A sequence whose scans are disturbed when they are read; ids, positions and times stay those of `original`.

    A scan's disturbance is a function of (`seed`, its row). Points that are not finite are left out.
    """

    original: ScanSequence
    disturbance: Disturbance
    seed: int

    def points(self, i: int) -> Float32[np.ndarray, "n 3"]:
        """Read and disturb scan `i`."""
        return self._disturbed(i)[0]

    def labels(self, i: int) -> Int32[np.ndarray, " n"] | None:
        """The raw ids of the points that are left of scan `i`, or None where it has no labels."""
        raw = self.original.labels(i)
        return None if raw is None else raw[self._disturbed(i)[1]]

    def _disturbed(self, i: int) -> tuple[Float32[np.ndarray, "m 3"], Int[np.ndarray, " m"]]:
        """The points that are left of scan `i`, and their rows in the original."""
        points = self.original.points(i)
        lasers = self.original.lasers(i) if self.disturbance.kind == "beams" else None
        rows = np.flatnonzero(np.isfinite(points).all(axis=1))
        lasers = None if lasers is None else lasers[rows]
        rng = np.random.default_rng((self.seed, i))
        try:
            points, kept = disturb(points[rows], self.disturbance, rng=rng, lasers=lasers)
        except ValueError as error:
            raise ValueError(f"scan {self.ids[i]} of sequence {self.name}: {self.disturbance.name}: {error}") from error
        return points, rows[kept]


def disturbed(sequence: Drive, disturbance: Disturbance, *, seed: int) -> DisturbedSequence:
    """The sequence with every scan disturbed by its own random draw; ValueError where it has only images."""
    if isinstance(sequence, ImageSequence):
        raise ValueError(
            f"{disturbance.name} needs points, found only images in sequence {sequence.name}, which can only be turned "
            "(rotation)"
        )
    same = {field.name: getattr(sequence, field.name) for field in dataclasses.fields(ScanSequence)}
    return DisturbedSequence(**same, original=sequence, disturbance=disturbance, seed=seed)
