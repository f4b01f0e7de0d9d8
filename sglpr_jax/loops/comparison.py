"""Comparison of a scan with stored scans: the nearest descriptors, and the best fit of the images with its evidence."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Complex, Complex64, Float, Float32, Int

from sglpr_jax.loops.compared_image import occupied
from sglpr_jax.loops.config import CandidateConfig, DriftModel, VerificationConfig
from sglpr_jax.loops.drift import on_other_floor
from sglpr_jax.loops.motion import Motion
from sglpr_jax.loops.pose_search import NO_PEAKS, Peak, search_spectra
from sglpr_jax.loops.probability import Evidence
from sglpr_jax.loops.rivals import distance_share, expected_poses, rival_share, rivals
from sglpr_jax.loops.seen import Seen
from sglpr_jax.loops.shortlist import coarse_correlations
from sglpr_jax.loops.stored_scans import StoredScans
from sglpr_jax.loops.transforms import transform
from sglpr_jax.loops.verification import Alignment, refined

BATCH, COARSE_BATCH = 10, 30
"""Number of matches of a batch, of the exact and of the coarse comparison."""


class Candidate(NamedTuple):
    """Two scans that may show one place."""

    query: int
    match: int
    """Frame numbers, counted from 0. The match is the earlier frame."""
    alignment: Alignment
    """Pose of the query's image in the frame of the match's image."""
    evidence: Evidence


@dataclasses.dataclass(frozen=True, eq=False)
class Comparer:
    """Compares scans with stored scans. The fields are those of the finder, and grow with it."""

    stored: StoredScans
    motion: Motion
    config: CandidateConfig
    verification: VerificationConfig
    drift: DriftModel

    def similar(self, descriptor: Float32[np.ndarray, " d"], excluded: Bool[np.ndarray, " n"]) -> Int[np.ndarray, " k"]:
        """Stored scans with the nearest descriptors, and those with the nearest ones at other times than the first."""
        rows = self.nearest(descriptor, self.config.candidates, excluded)
        if not len(rows):
            return rows
        excluded = excluded | self.about(int(rows[0]))
        return np.concatenate([rows, self.nearest(descriptor, self.config.elsewhere, excluded)])

    def fit(self, rows: Int[np.ndarray, " k"], found: Peak) -> Float[np.ndarray, " k"]:
        """How well each compared scan fits: its correlation."""
        return np.asarray(found.correlation)

    def fit_on_floor(self, rows: Int[np.ndarray, " k"], found: Peak) -> Float[np.ndarray, " k"]:
        """The correlation, and -2 added on another floor by odometry, because floors of a building look alike."""
        frames = self.stored.frames[rows]
        other = on_other_floor(self.motion.path, frames, found, self.drift) & self.motion.same(-1, frames)
        return np.asarray(found.correlation - 2 * other)

    def compared(
        self,
        descriptor: Float32[np.ndarray, " d"],
        spectra: Complex[Array, "2 s t f"],
        excluded: Bool[np.ndarray, " n"],
        *,
        fit: Callable[[Int[np.ndarray, " k"], Peak], Float[np.ndarray, " k"]],
    ) -> tuple[Int[np.ndarray, " k"], Peak]:
        """Stored scans that may show the place of a query, and its peaks over their images.

        These are the `similar` ones and, if none of them fits well, the best of `further` ones by a coarse comparison.
        Scans below `min_coarse_correlation` are left out.
        """
        config, similar = self.config, self.similar(descriptor, excluded)
        rows = self.possible(spectra, similar)
        found = self.search(spectra, self.stored.spectra(rows))
        if len(rows) and fit(rows, found).max() >= config.good_correlation:
            return rows, found
        pool = self.nearest(descriptor, config.further, excluded)
        chosen = self.possible(spectra, pool[~np.isin(pool, similar)])[: config.candidates]
        more = self.search(spectra, self.stored.spectra(chosen))
        return np.concatenate([rows, chosen]), Peak(*map(np.concatenate, zip(found, more, strict=True)))

    def possible(self, spectra: Complex[Array, "2 s t f"], rows: Int[np.ndarray, " k"]) -> Int[np.ndarray, " j"]:
        """Those of some stored scans that the coarse comparison does not rule out, the best first."""
        if not len(rows):
            return rows
        matches = batched(self.stored.spectra(rows), COARSE_BATCH)
        found = np.asarray(coarse_correlations(spectra, matches, len(rows), config=self.verification))[: len(rows)]
        best = np.argsort(-found, kind="stable")
        return rows[best[found[best] >= self.config.min_coarse_correlation]]

    def about(self, row: int) -> Bool[np.ndarray, " n"]:
        """Whether each stored scan was recorded at about the same time as one of them."""
        frames = self.stored.frames
        return self.motion.about(int(frames[row]), self.config.rivals.age[0] * self.config.exclude_s, frames)

    def nearest(
        self, descriptor: Float32[np.ndarray, " d"], k: int, excluded: Bool[np.ndarray, " n"]
    ) -> Int[np.ndarray, " j"]:
        """Up to k (0 or more) stored scans with the nearest descriptors, nearest first."""
        if not k:
            return np.zeros(0, np.int64)
        rows = self.stored.index.query(descriptor, k, exclude=excluded).rows
        return rows[rows >= 0]

    def candidate(
        self,
        query: int,
        seen: Seen,
        spectra: Complex[Array, "2 s t f"],
        compared: Int[np.ndarray, " k"],
        peaks: Peak,
        best: int,
    ) -> Candidate:
        """Candidate of frame `query` and the best compared scan. Compared scans that are known to show another place
        are rivals."""
        row, peak, stored = int(compared[best]), peaks.one(best), self.stored
        frames, image = stored.frames, stored.image(row)
        match = int(frames[row])
        distance = float(np.linalg.norm(self.stored.index.descriptors[row] - seen.descriptor))
        alignment = jax.device_get(refined(seen.image, image, peak, config=self.verification))
        rules, known = self.config.rivals, self.stored.index.descriptors
        exclude_s = self.config.exclude_s
        rows = rivals(seen.descriptor, known, frames, match, self.motion, exclude_s=exclude_s, config=rules)
        found = self.search(spectra, stored.spectra(rows))
        by_motion = expected_poses(self.motion, query, frames[rows], np.eye(4), config=rules)
        shares = self.shares(seen, match, distance, peak, rows, found, [by_motion])
        far = ~self.about(row)[compared] & self.motion.same(match, frames[compared])
        elsewhere = self.shares(seen, match, distance, peak, compared[far], peaks.some(far), [])
        shares = np.fmax(shares, elsewhere)
        cells = min(occupied(one, self.verification) for one in (seen.image, image))
        evidence = Evidence.of(distance, shares[0], alignment.correlation, alignment.second, shares[1], cells)
        return Candidate(query, match, alignment, evidence)

    def shares(
        self,
        seen: Seen,
        match: int,
        distance: float,
        peak: Peak,
        rows: Int[np.ndarray, " k"],
        found: Peak,
        expected: Sequence[tuple[Float[np.ndarray, "k 4 4"], Float[np.ndarray, " k"]]],
    ) -> tuple[float, float]:
        """`distance_share` and `rival_share` of a match, with the rivals `rows`."""
        rules, match_from_query = self.config.rivals, transform(float(peak.x), float(peak.y), float(peak.yaw))
        frames = self.stored.frames[rows]
        expected = [*expected, expected_poses(self.motion, match, frames, match_from_query, config=rules)]
        apart = np.linalg.norm(self.stored.index.descriptors[rows] - seen.descriptor, axis=1)
        return (
            distance_share(distance, apart, expected, config=rules),
            rival_share(found, float(peak.correlation), expected, config=rules),
        )

    def search(self, spectra: Complex[Array, "2 s t f"], matches: Sequence[Complex64[np.ndarray, "s f"]]) -> Peak:
        """Poses of a query in the frames of some matches."""
        if not matches:
            return NO_PEAKS
        found = search_spectra(spectra, batched(matches, BATCH), len(matches), config=self.verification)
        return jax.device_get(found).some(slice(len(matches)))


def batched(matches: Sequence[Complex64[np.ndarray, "s f"]], multiple: int) -> Complex64[np.ndarray, "k s f"]:
    """Stack spectra, and pad them to a multiple of a number, because each size compiles its own program."""
    found = np.zeros((-(-len(matches) // multiple) * multiple, *matches[0].shape), np.complex64)
    found[: len(matches)] = matches
    return found
