"""Comparison of a scan with stored scans: the best match, and the evidence that it shows the same place.

The query is also compared with distractors: scans that show other places, according to the motion. If a distractor fits
about as well as the match, the fit proves little. Only travelled distances count, not frame rate or speed.
"""

import dataclasses
import functools
import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Float32, Int, Shaped, UInt8

from sglpr_jax.loops.config import CandidateConfig
from sglpr_jax.loops.keyframes import EVERY, Keyframes
from sglpr_jax.loops.odometry_deviation import planar_covariance, planar_deviations
from sglpr_jax.loops.probability import Evidence
from sglpr_jax.odometry.bev_odometry import BevOdometry
from sglpr_jax.odometry.drift_model import DriftModel
from sglpr_jax.registration.bev_alignment import BevRegistration, refine
from sglpr_jax.registration.bev_config import VerificationConfig
from sglpr_jax.registration.bev_search import (
    NO_PEAKS,
    CorrelationPeak,
    coarse_correlations,
    coarse_query,
    likely_rotations,
    search,
)
from sglpr_jax.registration.bev_spectra import query_spectra
from sglpr_jax.se3 import PlanarPose, compose_planar, inverse_planar

BATCH, COARSE_BATCH = 8, 32
"""Batches of the exact and of the coarse comparison are padded to a multiple of these numbers of matches."""
DISTRACTOR_M = 10.0
"""Minimum travelled distance of a distractor from query and match, in metres."""
EXACT_COHORT, EXACT_NEAR_COHORT = 6, 3
"""Numbers of distractors that are compared exactly, the best by the coarse comparison: elsewhere, and near."""
SURROUNDINGS_M, SYMMETRIES = 300.0, 4
"""Side of the square in which a lookalike of a place may be, in metres, and number of rotations at which it may fit:
walls stand at right angles."""


class Candidate(NamedTuple):
    """Two scans that may show one place."""

    query: int
    match: int
    """Frame numbers, counted from 0. The match is the earlier frame."""
    alignment: BevRegistration
    """Pose of the query's image in the frame of the match's image."""
    evidence: Evidence


class Fits(NamedTuple):
    """Comparisons of a query with other scans, from which its candidates are chosen."""

    frames: Int[np.ndarray, " k"]
    """Frames of the other scans."""
    peaks: CorrelationPeak
    """Poses of the query in the frames of the other scans, and correlations."""
    link: BevRegistration | None = None
    """Pose of the query in the frame of the motion's reference or, with odometry, of the last scan that checked it."""
    lookalike: float = math.nan
    """Highest coarse correlation with a scan that certainly shows another place. NaN if there is no such scan."""

    @property
    def poses(self) -> PlanarPose:
        """Pose of the query in the frame of each other scan."""
        return np.stack([self.peaks.x, self.peaks.y, self.peaks.yaw], axis=-1, dtype=np.float64)

    @classmethod
    def joined(cls, *parts: "Fits") -> "Fits":
        """Concatenate comparisons of one query, without their links and lookalikes."""
        fields = zip(*(fits.peaks for fits in parts), strict=True)
        return cls(np.concatenate([fits.frames for fits in parts]), CorrelationPeak(*map(np.concatenate, fields)))


class CoarseFits(NamedTuple):
    """Coarse comparisons of a query with stored scans."""

    rows: Int[np.ndarray, " k"]
    """Row of each stored scan."""
    correlation: Float[np.ndarray, " k"]
    """Highest correlation at any pose."""
    rotations: Int[np.ndarray, "k n"]
    """Likely rotations, at which the images are compared exactly."""

    def at(self, which: slice | np.ndarray) -> "CoarseFits":
        """Select some of the comparisons."""
        return CoarseFits(*(field[which] for field in self))


NO_FITS = Fits(np.zeros(0, np.int64), NO_PEAKS)


@dataclasses.dataclass(frozen=True, eq=False)
class Query:
    """A scan that is compared with others."""

    frame: int
    """Frame number in the motion."""
    descriptor: Float32[np.ndarray, " d"]
    image: UInt8[np.ndarray, "m m"]
    """Density image. Only its part `within_reach` is compared."""
    verification: VerificationConfig = VerificationConfig()

    @functools.cached_property
    def spectra(self) -> Complex[Array, "s t f"]:
        """Result of `query_spectra`, computed at the first comparison."""
        return query_spectra(self.image, config=self.verification)

    @property
    def own_spectrum(self) -> Complex[np.ndarray, "s f"]:
        """Spectrum of the scan itself, as of a match (`match_spectra`): the first rotation of `spectra`."""
        return np.asarray(self.spectra)[:, 0]

    @functools.cached_property
    def coarse_spectra(self) -> Complex[Array, "r u g"]:
        """Result of `coarse_query`, computed at the first comparison."""
        return coarse_query(self.spectra, config=self.verification)


@dataclasses.dataclass(frozen=True, eq=False)
class KeyframeComparison:
    """Compares queries with stored scans."""

    motion: BevOdometry
    """Motion of all frames. It may grow."""
    drift: DriftModel
    """Drift of this motion."""
    config: CandidateConfig = CandidateConfig()
    verification: VerificationConfig = VerificationConfig()
    loops: Int[np.ndarray, "l 2"] = dataclasses.field(default_factory=lambda: np.zeros((0, 2), np.int64))
    """Frames of query and match of each accepted loop."""

    def compare(
        self, query: Query, searched: Keyframes, *others: Keyframes, possible: Bool[np.ndarray, " n"] | None = None
    ) -> Fits:
        """Compare a query with the scans most like it: first possible matches, then distractors of the best match.

        Arguments:
          query: The scan. Its frame is part of the motion.
          searched: Scans among which the match is sought.
          others: Further scans for distractors, such as those of the query's own recording.
          possible: Whether each searched scan may be the match. By default, the motion decides.
        """
        config, frames = self.config, searched.frames
        if possible is None:
            is_other_pass = self.travelled_between(frames, query.frame) >= config.recent_m
            possible = is_other_pass & ~self.are_elsewhere(frames, query.frame)
        coarse = self._most_similar(query, searched, config.further, possible)
        fits, best = NO_FITS, None
        for start, end in itertools.pairwise((0, 1, config.candidates, 2 * config.candidates)):
            is_clear = best is not None and fits.peaks.correlation[best] >= config.good_correlation
            if start == config.candidates and is_clear:
                break
            group = coarse.at(slice(start, end))
            group = group.at(group.correlation >= self._least_that_matters(fits, best))
            if not len(group.rows):
                continue
            fits = Fits.joined(fits, self._compare_exactly(query, searched, group))
            best = self._best_consistent_with_motion(query.frame, fits, EVERY)
        best = self._best(query.frame, fits, EVERY) if best is None else best
        if best is not None and fits.peaks.correlation[best] < config.min_correlation:
            best = None  # no candidate
        lookalike = math.nan
        for scans in (searched, *others):
            distractors = self._compare_distractors(query, fits, best, scans)
            fits, lookalike = Fits.joined(fits, distractors), np.fmax(lookalike, distractors.lookalike)
        return fits._replace(lookalike=float(lookalike))

    def _least_that_matters(self, fits: Fits, best: int | None) -> float:
        """Least coarse correlation of a further scan that is compared exactly, given the best fit so far (a row).

        Coarse correlations are rarely below exact ones. A scan below the second peak of the best fit could not make its
        ambiguity ratio worse.
        """
        return self.config.min_coarse_correlation if best is None else float(fits.peaks.second[best])

    def candidates(
        self, query: Query, fits: Fits, searched: Keyframes, *, possible: Bool[np.ndarray, "*k"] = EVERY
    ) -> list[Candidate]:
        """Candidates of a query: the best match that the motion allows and, if it differs, the best match of all.

        The latter can show that the motion is wrong. Only `possible` fits outside of the query's own pass count, of at
        least `min_correlation`. Their scans are `searched`.
        """
        rows = self._best_consistent_with_motion(query.frame, fits, possible), self._best(query.frame, fits, possible)
        return [
            self.candidate_of_fit(query, fits, row, searched)
            for row in dict.fromkeys(rows)  # without duplicates
            if row is not None and fits.peaks.correlation[row] >= self.config.min_correlation
        ]

    def candidate_of_fit(self, query: Query, fits: Fits, row: int, searched: Keyframes) -> Candidate:
        """Register the images of a query and of the scan of one fit (`row`), and collect the evidence.

        The ambiguity ratio is the highest correlation that speaks against the match, divided by that of the match. For
        distractors, whose fits exclude the match according to the motion, it is that of the best pose. For the match
        and all other scans, it is that of the second-best pose.
        """
        match, peak, poses = int(fits.frames[row]), fits.peaks.at(row), fits.poses
        deviations, limit = self.deviations(query.frame, fits.frames, poses), self.drift.max_deviation
        # Pose of the match in the frame of each scan, if the query fits both. The motion between them may exclude it.
        scans_from_match = compose_planar(poses, inverse_planar(poses[row]))
        excludes_match = self.deviations(match, fits.frames, scans_from_match) > limit
        excludes_match |= (deviations > limit) & (deviations[row] <= limit)
        excludes_match &= ~self.are_joined(match, fits.frames) & (fits.frames != match)
        opposing = np.where(excludes_match, fits.peaks.correlation, fits.peaks.second)
        ambiguity_ratio = float(opposing.max()) / max(float(peak.correlation), 1e-6)
        image = searched.image(int(np.searchsorted(searched.frames, match)))
        registration = jax.device_get(refine(query.image, image, peak, config=self.verification))
        surprise = self.surprise(query.frame, match)
        evidence = Evidence.of(ambiguity_ratio, registration.along_m, deviations[row], surprise)
        return Candidate(query.frame, match, registration, evidence)

    def surprise(self, query: int, match: int) -> float:
        """Logarithm of the number of poses of a lookalike over the number of poses that the motion allows the query.

        A lookalike may be anywhere in a square of `SURROUNDINGS_M`, at `SYMMETRIES` rotations. The result is negative
        if the motion allows more positions than the square has.
        """
        covariance = planar_covariance(self.motion.path, np.array([query]), np.array([match]), drift=self.drift)[0]
        area_m2 = 2 * np.pi * np.sqrt(np.linalg.det(covariance[:2, :2]))
        yaw_range = max(2 * self.drift.max_deviation * np.sqrt(covariance[2, 2]), 2 * np.pi / SYMMETRIES)
        return float(np.log(SURROUNDINGS_M**2 / area_m2) + max(np.log(2 * np.pi / yaw_range), 0))

    def _best(self, query: int, fits: Fits, allowed: Bool[np.ndarray, "*k"]) -> int | None:
        """Row of the allowed fit of another pass (`recent_m`) with the highest correlation, or None."""
        allowed = allowed & (self.travelled_between(fits.frames, query) >= self.config.recent_m)
        return int(np.argmax(np.where(allowed, fits.peaks.correlation, -1.0))) if allowed.any() else None

    def _best_consistent_with_motion(self, query: int, fits: Fits, allowed: Bool[np.ndarray, "*k"]) -> int | None:
        """Result of `_best` among the allowed fits whose poses deviate from the motion by at most `max_deviation`."""
        if not len(fits.frames):
            return None
        deviations = self.deviations(query, fits.frames, fits.poses)
        return self._best(query, fits, (deviations <= self.drift.max_deviation) & allowed)

    def travelled_between(self, frames: Int[np.ndarray, " k"], frame: int) -> Float[np.ndarray, " k"]:
        """Travelled distance between a frame and each of `frames`, in metres."""
        return np.abs(self.motion.travelled[frames] - self.motion.travelled[frame])

    def are_elsewhere(self, frames: Int[np.ndarray, " k"], frame: int) -> Bool[np.ndarray, " k"]:
        """Whether each of `frames` certainly shows another place than `frame`, according to the motion."""
        path = self.motion.path
        apart_m = np.linalg.norm(path.poses[frames, :3, 3] - path.poses[frame, :3, 3], axis=1)
        drift_m = path.position_deviations(frames, frame, drift=self.drift)
        max_shift_m = np.sqrt(2) * self.verification.max_shift_m  # along x and y at once
        return apart_m > max_shift_m + self.drift.max_deviation * drift_m

    def _compare_distractors(self, query: Query, fits: Fits, best: int | None, scans: Keyframes) -> Fits:
        """Compare a query with the distractors most like it, of two kinds, given its fits and the best of them (a row).

        One kind shows another place than the query or the match. The other is less than two `recent_m` of travel from
        one of them: its fit may contradict the motion. Without a match, a few of the first kind are compared, exactly
        only if they are very similar, because they may show that the motion is wrong.
        """
        config, frames = self.config, scans.frames
        match = query.frame if best is None else int(fits.frames[best])
        travelled_m = np.stack([self.travelled_between(frames, frame) for frame in (query.frame, match)])
        distracts = (travelled_m >= DISTRACTOR_M).all(axis=0)
        elsewhere = self.are_elsewhere(frames, query.frame) | self.are_elsewhere(frames, match)
        near = (travelled_m < 2 * config.recent_m).any(axis=0) & ~elsewhere
        if best is None:
            cohort, near_cohort, least = config.candidates, 0, config.good_correlation
        else:
            cohort, near_cohort, least = config.cohort, config.near_cohort, self._least_that_matters(fits, best)
        far = self._most_similar(query, scans, cohort, elsewhere & distracts)
        close = self._most_similar(query, scans, near_cohort, near & distracts)
        best_of_each = far.at(slice(EXACT_COHORT)), close.at(slice(EXACT_NEAR_COHORT))
        compared = [self._compare_exactly(query, scans, group.at(group.correlation >= least)) for group in best_of_each]
        return Fits.joined(*compared)._replace(lookalike=float(far.correlation[0]) if len(far.rows) else math.nan)

    def _most_similar(self, query: Query, scans: Keyframes, count: int, among: Bool[np.ndarray, " n"]) -> CoarseFits:
        """Compare the `count` scans with the nearest descriptors coarsely. The highest correlation comes first.

        Only scans with a flag in `among` count.
        """
        rows = scans.nearest(query.descriptor, count, among)
        if not len(rows):
            return CoarseFits(rows, np.zeros(0), np.zeros((0, 0), np.int64))
        matches = _batched([spectra.coarse for spectra in scans.spectra(rows)], COARSE_BATCH)
        correlations = coarse_correlations(query.coarse_spectra, matches, len(rows), config=self.verification)
        by_rotation = np.asarray(correlations)[: len(rows)]
        fits = CoarseFits(rows, by_rotation.max(1), likely_rotations(by_rotation))
        return fits.at(np.argsort(-fits.correlation, kind="stable"))

    def _compare_exactly(self, query: Query, scans: Keyframes, coarse: CoarseFits) -> Fits:
        """Compare the images of a query and of stored scans at the likely rotations and all shifts."""
        rows = coarse.rows
        if not len(rows):
            return NO_FITS
        matches = _batched([spectra.exact for spectra in scans.spectra(rows)], BATCH)
        rotations = _batched(list(coarse.rotations), BATCH)
        peaks = jax.device_get(search(query.spectra, matches, len(rows), rotations, config=self.verification))
        return Fits(scans.frames[rows], peaks.at(slice(len(rows))))

    def deviations(
        self, query: int, matches: Int[np.ndarray, " k"], match_from_query: PlanarPose
    ) -> Float[np.ndarray, " k"]:
        """Deviation from the motion, in standard deviations, of the pose of a frame in the frame of each match."""
        queries = np.full(len(matches), query)
        return planar_deviations(self.motion.path, queries, matches, match_from_query, drift=self.drift)

    def are_joined(self, match: int, frames: Int[np.ndarray, " k"]) -> Bool[np.ndarray, " k"]:
        """Whether an accepted loop shows that a frame and a match are of one place, up to `recent_m` of travel."""
        joined = np.zeros(len(frames), bool)
        query, earlier = self.loops.T
        for ends, other_ends in ((query, earlier), (earlier, query)):
            is_near_match = self.travelled_between(ends, match) < self.config.recent_m
            for frame in other_ends[is_near_match].tolist():
                joined |= self.travelled_between(frames, frame) < self.config.recent_m
        return joined


def _batched(arrays: Sequence[Shaped[np.ndarray, "*s"]], multiple: int) -> Shaped[np.ndarray, "k *s"]:
    """Stack arrays, and pad the stack with zeros to a multiple of `multiple`, because each size compiles a program."""
    padded_length = -(-len(arrays) // multiple) * multiple
    batch = np.zeros((padded_length, *arrays[0].shape), arrays[0].dtype)
    batch[: len(arrays)] = arrays
    return batch
