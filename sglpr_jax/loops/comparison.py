"""Comparison of a scan with stored scans: the nearest descriptors, and the best fit of the images with its evidence."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Float32, Int, UInt8

from sglpr_jax.loops.config import CandidateConfig, DriftModel, VerificationConfig
from sglpr_jax.loops.drift import on_other_floor
from sglpr_jax.loops.motion import Motion
from sglpr_jax.loops.pose_search import NO_PEAKS, Peak, occupied, search_spectra
from sglpr_jax.loops.probability import Evidence
from sglpr_jax.loops.rivals import distance_share, expected_poses, rival_share, rivals
from sglpr_jax.loops.seen import Seen
from sglpr_jax.loops.shortlist import shortlist
from sglpr_jax.loops.stored_scans import StoredScans
from sglpr_jax.loops.transforms import transform
from sglpr_jax.loops.verification import Alignment, refined


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

    def with_further(
        self,
        seen: Seen,
        spectra: Complex[Array, "s t f"],
        rows: Int[np.ndarray, " k"],
        found: Peak,
        excluded: Bool[np.ndarray, " n"],
        *,
        fit: Callable[[Int[np.ndarray, " k"], Peak], Float[np.ndarray, " k"]],
    ) -> tuple[Int[np.ndarray, " j"], Peak]:
        """Compared scans and their peaks, with further scans if none of the compared ones fits well."""
        config = self.config
        if fit(rows, found).max() >= config.good_correlation:
            return rows, found
        pool = self.nearest(seen.descriptor, config.further, excluded)
        pool = pool[~np.isin(pool, rows)]
        images = [self.stored.image(row) for row in pool.tolist()]
        chosen = pool[shortlist(seen.image, images, config.candidates, size=config.further, config=self.verification)]
        more = self.search(spectra, [self.stored.image(row) for row in chosen.tolist()], config.candidates)
        return np.concatenate([rows, chosen]), Peak(*map(np.concatenate, zip(found, more, strict=True)))

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
        spectra: Complex[Array, "s t f"],
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
        shares = np.nan, np.nan
        if peak.correlation >= self.config.min_rival_correlation:
            rules, known = self.config.rivals, self.stored.index.descriptors
            exclude_s = self.config.exclude_s
            rows = rivals(seen.descriptor, known, frames, match, self.motion, exclude_s=exclude_s, config=rules)
            found = self.search(spectra, [stored.image(one) for one in rows.tolist()], rules.of_query + rules.of_match)
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

    def search(
        self,
        spectra: Complex[Array, "s t f"],
        matches: Sequence[UInt8[np.ndarray, "n n"]],
        size: int,
        priors: Float[np.ndarray, "k 3"] | None = None,
    ) -> Peak:
        """Poses of a query in the frames of some matches. The batch is padded to `size`, so that it compiles once."""
        if not matches:
            return NO_PEAKS
        chosen = np.arange(size) % len(matches)
        expected = np.full((size, 3), np.nan) if priors is None else priors[chosen]
        padded = np.stack([matches[k] for k in chosen.tolist()])
        found = jax.device_get(search_spectra(spectra, padded, expected.astype(np.float32), config=self.verification))
        return found.some(slice(len(matches)))
