"""Comparison of a scan with stored scans: the best match, and the evidence that it shows the same place.

The query is also compared with scans that the motion puts elsewhere. If one of these distractors fits about as well as
the match, the fit proves little. All is measured in travelled distance and standard deviations of the motion, not time.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Complex, Complex64, Float, Float32, Int, UInt8

from sglpr_jax.loops.closure import Planar, compose, inverse_planar
from sglpr_jax.loops.config import CandidateConfig
from sglpr_jax.loops.drift import planar_deviations, planar_spread
from sglpr_jax.loops.keyframes import Keyframes
from sglpr_jax.loops.probability import Evidence
from sglpr_jax.odometry.bev_odometry import BevOdometry
from sglpr_jax.odometry.config import DriftModel
from sglpr_jax.registration.bev_alignment import BevRegistration, refined
from sglpr_jax.registration.bev_search import NO_PEAKS, CorrelationPeak, coarse_correlations, search
from sglpr_jax.registration.config import VerificationConfig

BATCH, COARSE_BATCH = 8, 32
"""Number of matches of a batch, of the exact and of the coarse comparison."""
BESIDE_M = 10.0
"""Minimum travelled distance from query and match to the scans that show other places, in metres."""
EXACT_COHORT, EXACT_NEAR_COHORT = 6, 3
"""Numbers of scans of the two cohorts, the best by the coarse comparison, whose images are compared exactly."""
EVERY = np.array(True)
SURROUNDINGS_M, SYMMETRIES = 300.0, 4
"""Side of the square in which a lookalike may stand, in metres, and number of rotations at which it may fit."""


Spectra = Complex[Array, "2 s t f"]
"""Result of `query_spectra`."""


class Candidate(NamedTuple):
    """Two scans that may show one place."""

    query: int
    match: int
    """Frame numbers, counted from 0. The match is the earlier frame."""
    alignment: BevRegistration
    """Pose of the query's image in the frame of the match's image."""
    evidence: Evidence


class Fits(NamedTuple):
    """Fits of a query with other scans, from which its candidates are chosen."""

    frames: Int[np.ndarray, " k"]
    """Frames of the other scans."""
    peaks: CorrelationPeak
    """Poses of the query in the frames of the other scans, and correlations."""
    link: BevRegistration | None = None
    """Pose of the query in the frame of the keyframe, from which the motion without odometry is computed."""


NO_FITS = Fits(np.zeros(0, np.int64), NO_PEAKS)


class Query(NamedTuple):
    """A scan that is compared."""

    frame: int
    """Frame number in the motion."""
    descriptor: Float32[np.ndarray, " d"]
    image: UInt8[np.ndarray, "m m"]
    spectra: Spectra | None
    """Result of `query_spectra`. None if the scan was already compared."""


@dataclasses.dataclass(frozen=True, eq=False)
class KeyframeComparison:
    """Compares queries with stored scans."""

    motion: BevOdometry
    """Motion of all frames. It may grow."""
    drift: DriftModel
    """Drift of this motion."""
    config: CandidateConfig = CandidateConfig()
    verification: VerificationConfig = VerificationConfig()
    joined: Int[np.ndarray, "l 2"] = dataclasses.field(default_factory=lambda: np.zeros((0, 2), np.int64))
    """Frames of the queries and matches of accepted loops, which join passes of one place."""

    def compare(
        self, query: Query, searched: Keyframes, *others: Keyframes, possible: Bool[np.ndarray, " n"] | None = None
    ) -> Fits:
        """Compare a query with the scans most like it: possible matches, and scans that show other places.

        Arguments:
          query: The scan. Its frame is part of the motion.
          searched: Scans among which the match is sought.
          others: Further scans that show other places, such as those of the query's own recording.
          possible: Whether each searched scan may be the match. By default the motion decides.
        """
        config, frames = self.config, searched.frames
        if possible is None:  # not of the same pass, and not elsewhere
            possible = (self.way_m(frames, query.frame) >= config.recent_m) & ~self.elsewhere(frames, query.frame)
        rows, coarse = self._nearest(query, searched, config.further, possible)
        rows = rows[coarse >= config.min_coarse_correlation]
        first, more = np.split(rows[: 2 * config.candidates], [config.candidates])
        found = self._compared(query, searched, first)
        best = self._best(query.frame, found, EVERY)
        if best is None or found.peaks.correlation[best] < config.good_correlation:
            found = _joined(found, self._compared(query, searched, more))
            best = self._highest(query.frame, found, EVERY) if best is None else best
        match = query.frame if best is None else int(found.frames[best])
        return _joined(found, *(self._cohort(query, match, store) for store in (searched, *others)))

    def candidates(
        self, query: Query, fits: Fits, searched: Keyframes, *, possible: Bool[np.ndarray, "*k"] = EVERY
    ) -> list[Candidate]:
        """Choose the match of a query among the `searched` scans, and collect the evidence, if anything fits.

        If another scan fits better, but contradicts the motion, it is a second candidate. It can show that the motion
        is wrong. Only `possible` fits outside of the query's own pass count.
        """
        best, any_best = self._best(query.frame, fits, possible), self._highest(query.frame, fits, possible)
        chosen = [row for row in dict.fromkeys((best, any_best)) if row is not None]
        high = [row for row in chosen if fits.peaks.correlation[row] >= self.config.min_correlation]
        return [self.candidate(query, fits, row, searched) for row in high]

    def candidate(self, query: Query, fits: Fits, row: int, searched: Keyframes) -> Candidate:
        """Collect the evidence of one fit.

        The poses of other scans that the motion excludes count against it. So do second-best poses, those of the match
        and of scans whose best poses the motion allows.
        """
        match, peak, poses = int(fits.frames[row]), fits.peaks.at(row), _planar(fits.peaks)
        deviations, most = self.deviations(query.frame, fits.frames, poses), self.drift.max_deviation
        # The motion between the match and another scan may exclude that the query fits both.
        others = self.deviations(match, fits.frames, compose(poses, inverse_planar(poses[row])))
        distracts = (others > most) | ((deviations > most) & (deviations[row] <= most))
        distracts &= ~self.are_joined(match, fits.frames) & (fits.frames != match)
        rivals = np.where(distracts, fits.peaks.correlation, fits.peaks.second)
        ambiguity = float(rivals.max()) / max(float(peak.correlation), 1e-6)
        image = searched.image(int(np.searchsorted(searched.frames, match)))
        alignment = jax.device_get(refined(query.image, image, peak, config=self.verification))
        evidence = Evidence.of(ambiguity, alignment.along_m, deviations[row], self.surprise(query.frame, match))
        return Candidate(query.frame, match, alignment, evidence)

    def surprise(self, query: int, match: int) -> float:
        """Logarithm of all poses that a sensor may have over those within the uncertainty of the motion.

        A lookalike stands anywhere in the surroundings, at one of `SYMMETRIES` rotations, because walls stand at right
        angles. The result is negative if the motion allows more positions than the surroundings have.
        """
        spread = planar_spread(self.motion.path, np.array([query]), np.array([match]), drift=self.drift)[0]
        area = 2 * np.pi * np.sqrt(np.linalg.det(spread[:2, :2]))
        rotation = max(2 * self.drift.max_deviation * np.sqrt(spread[2, 2]), 2 * np.pi / SYMMETRIES)
        return float(np.log(SURROUNDINGS_M**2 / area) + max(np.log(2 * np.pi / rotation), 0))

    def _highest(self, query: int, fits: Fits, allowed: Bool[np.ndarray, "*k"]) -> int | None:
        """The flagged fit with the highest correlation, not of the query's own pass."""
        flags = allowed & (self.way_m(fits.frames, query) >= self.config.recent_m)
        return int(np.argmax(np.where(flags, fits.peaks.correlation, -1.0))) if flags.any() else None

    def _best(self, query: int, fits: Fits, possible: Bool[np.ndarray, "*k"]) -> int | None:
        """The possible fit with the highest correlation among those that the motion allows."""
        deviations = self.deviations(query, fits.frames, _planar(fits.peaks))
        return self._highest(query, fits, (deviations <= self.drift.max_deviation) & possible)

    def way_m(self, frames: Int[np.ndarray, " k"], frame: int) -> Float[np.ndarray, " k"]:
        """Travelled distance between a frame and each of others, in metres."""
        return np.abs(self.motion.travelled[frames] - self.motion.travelled[frame])

    def elsewhere(self, frames: Int[np.ndarray, " k"], frame: int) -> Bool[np.ndarray, " k"]:
        """Whether each of some frames certainly shows another place than a frame, according to the motion."""
        path = self.motion.path
        apart = np.linalg.norm(path.poses[frames, :3, 3] - path.poses[frame, :3, 3], axis=1)
        drifted = path.position_deviations(frames, frame, drift=self.drift)
        place_m = np.sqrt(2) * self.verification.max_shift_m  # largest shift along x and y
        return apart > place_m + self.drift.max_deviation * drifted

    def _cohort(self, query: Query, match: int, store: Keyframes) -> Fits:
        """Compare a query with the scans most like it that show another place than the query or the match, and with
        those near enough to contradict the motion by their fit."""
        config, frames = self.config, store.frames
        ways = np.stack([self.way_m(frames, frame) for frame in (query.frame, match)])
        beside = (ways >= BESIDE_M).all(axis=0)
        other = self.elsewhere(frames, query.frame) | self.elsewhere(frames, match)
        near = (ways < 2 * config.recent_m).any(axis=0) & ~other
        found = []
        for count, exact, flags in (
            (config.cohort, EXACT_COHORT, other & beside),
            (config.near_cohort, EXACT_NEAR_COHORT, near & beside),
        ):
            found.append(self._compared(query, store, self._nearest(query, store, count, flags)[0][:exact]))
        return _joined(*found)

    def _nearest(
        self, query: Query, store: Keyframes, count: int, among: Bool[np.ndarray, " n"]
    ) -> tuple[Int[np.ndarray, " k"], Float[np.ndarray, " k"]]:
        """Scans with the nearest descriptors, and their correlations by the coarse comparison, the highest first."""
        rows = store.nearest(query.descriptor, count, among)
        if not len(rows):
            return rows, np.zeros(0)
        assert query.spectra is not None
        matches = _batched(store.spectra(rows), COARSE_BATCH)
        found = np.asarray(coarse_correlations(query.spectra, matches, len(rows), config=self.verification))[
            : len(rows)
        ]
        order = np.argsort(-found, kind="stable")
        return rows[order], found[order]

    def _compared(self, query: Query, store: Keyframes, rows: Int[np.ndarray, " k"]) -> Fits:
        """Compare the images of a query and of some stored scans at all rotations and shifts."""
        if not len(rows):
            return NO_FITS
        assert query.spectra is not None
        matches = _batched(store.spectra(rows), BATCH)
        found = jax.device_get(search(query.spectra, matches, len(rows), config=self.verification))
        return Fits(store.frames[rows], found.at(slice(len(rows))))

    def deviations(
        self, query: int, matches: Int[np.ndarray, " k"], match_from_query: Planar
    ) -> Float[np.ndarray, " k"]:
        """Deviation of poses of a frame in the frames of others from the motion, in standard deviations."""
        queries = np.full(len(matches), query)
        return planar_deviations(self.motion.path, queries, matches, match_from_query, drift=self.drift)

    def are_joined(self, match: int, frames: Int[np.ndarray, " k"]) -> Bool[np.ndarray, " k"]:
        """Whether an accepted loop joins the surroundings of each frame with those of a match."""
        found = np.zeros(len(frames), bool)
        for a, b in (self.joined.T, self.joined.T[::-1]):
            close = self.way_m(a, match) < self.config.recent_m
            for end in b[close].tolist():
                found |= self.way_m(frames, end) < self.config.recent_m
        return found


def _planar(found: CorrelationPeak) -> Planar:
    return np.stack([np.asarray(values, np.float64) for values in (found.x, found.y, found.yaw)], axis=-1)


def _joined(*fits: Fits) -> Fits:
    frames, peaks, _ = zip(*fits, strict=True)
    return Fits(np.concatenate(frames), CorrelationPeak(*map(np.concatenate, zip(*peaks, strict=True))))


def _batched(matches: Sequence[Complex64[np.ndarray, "s f"]], multiple: int) -> Complex64[np.ndarray, "k s f"]:
    """Stack spectra, and pad them to a multiple of a number, because each size compiles its own program."""
    found = np.zeros((-(-len(matches) // multiple) * multiple, *matches[0].shape), np.complex64)
    found[: len(matches)] = matches
    return found
