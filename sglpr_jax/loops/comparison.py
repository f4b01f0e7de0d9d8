"""Comparison of a scan with stored scans: the best match, and the evidence that it shows the same place.

The evidence asks the drive itself. The query is also compared with scans that the motion puts elsewhere, or that cannot
show the place of the match. If one of these distractors fits about as well as the match, the fit proves little. A fit
is a distractor if its pose contradicts the motion to the query or to the match. Everything is measured in metres of
travelled distance and in standard deviations of the motion. Times have no influence.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol, runtime_checkable

import jax
import numpy as np
from jaxtyping import Array, Bool, Complex, Complex64, Float, Float32, Int, UInt8

from sglpr_jax.loops.closure import Planar, compose, inverted
from sglpr_jax.loops.config import CandidateConfig
from sglpr_jax.loops.drift import planar_deviations, planar_spread
from sglpr_jax.loops.probability import Evidence
from sglpr_jax.odometry.bev_odometry import Motion
from sglpr_jax.odometry.config import DriftModel
from sglpr_jax.registration.bev_alignment import Alignment, refined
from sglpr_jax.registration.bev_search import NO_PEAKS, Peak, coarse_correlations, search_spectra
from sglpr_jax.registration.config import VerificationConfig

BATCH, COARSE_BATCH = 8, 32
"""Number of matches of a batch, of the exact and of the coarse comparison."""
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
    alignment: Alignment
    """Pose of the query's image in the frame of the match's image."""
    evidence: Evidence


class Fits(NamedTuple):
    """Fits of a query with other scans, from which its candidates are chosen."""

    frames: Int[np.ndarray, " k"]
    """Frames of the other scans."""
    peaks: Peak
    """Poses of the query in the frames of the other scans, and correlations."""


NO_FITS = Fits(np.zeros(0, np.int64), NO_PEAKS)


class Query(NamedTuple):
    """A scan that is compared."""

    frame: int
    """Frame number in the motion."""
    descriptor: Float32[np.ndarray, " d"]
    image: UInt8[np.ndarray, "m m"]
    spectra: Spectra | None
    """Result of `query_spectra`. None if the scan was already compared."""


@runtime_checkable
class Stored(Protocol):
    """Scans that a query is compared with, such as `StoredScans`."""

    @property
    def frames(self) -> Int[np.ndarray, " n"]:
        """Frame of each scan in the motion."""
        ...

    def nearest(
        self, descriptor: Float32[np.ndarray, " d"], k: int, among: Bool[np.ndarray, " n"]
    ) -> Int[np.ndarray, " j"]:
        """Up to k scans with the nearest descriptors, nearest first."""
        ...

    def image(self, row: int) -> UInt8[np.ndarray, "m m"]:
        """Image of a scan."""
        ...

    def spectra(self, rows: Int[np.ndarray, " k"]) -> list[Complex64[np.ndarray, "s f"]]:
        """Spectrum of each scan's image (`match_spectra`)."""
        ...


@dataclasses.dataclass(frozen=True, eq=False)
class Comparer:
    """Compares queries with stored scans."""

    motion: Motion
    """Motion of all frames. It may grow."""
    drift: DriftModel
    """Drift of this motion."""
    config: CandidateConfig = CandidateConfig()
    verification: VerificationConfig = VerificationConfig()
    joined: Int[np.ndarray, "l 2"] = dataclasses.field(default_factory=lambda: np.zeros((0, 2), np.int64))
    """Frames of the queries and matches of accepted loops, which join passes of one place."""

    def compare(
        self, query: Query, searched: Stored, *others: Stored, possible: Bool[np.ndarray, " n"] | None = None
    ) -> Fits:
        """Compare a query with the scans most like it: possible matches, and scans that show other places.

        Arguments:
          query: The scan. Its frame is part of the motion.
          searched: Scans among which the match is sought.
          others: Further scans that show other places, such as those of the query's own recording.
          possible: Whether each searched scan may be the match. By default the motion decides.
        """
        config = self.config
        possible = self.possible(searched.frames, query.frame) if possible is None else possible
        rows = searched.nearest(query.descriptor, config.further, possible)
        coarse = self.coarse(query.spectra, searched.spectra(rows))
        rows = rows[np.argsort(-coarse, kind="stable")][: int((coarse >= config.min_coarse_correlation).sum())]
        first, more = np.split(rows[: 2 * config.candidates], [config.candidates])
        found = self._compared(query, searched, first)
        best = self.best(query.frame, found)
        if best is None or found.peaks.correlation[best] < config.good_correlation:
            found = _joined(found, self._compared(query, searched, more))
            best = self._highest(query.frame, found, EVERY) if best is None else best
        match = query.frame if best is None else int(found.frames[best])
        return _joined(found, *(self._cohort(query, match, store) for store in (searched, *others)))

    def possible(self, frames: Int[np.ndarray, " k"], query: int) -> Bool[np.ndarray, " k"]:
        """Whether each frame may show the place of the query: not of the same pass, and not elsewhere."""
        return (self.way_m(frames, query) >= self.config.recent_m) & ~self.elsewhere(frames, query)

    def best(self, query: int, fits: Fits, possible: Bool[np.ndarray, "*k"] = EVERY) -> int | None:
        """The fit with the highest correlation among those that the motion allows."""
        allowed = self._deviations(query, fits) <= self.drift.max_deviation
        return self._highest(query, fits, allowed & possible)

    def candidates(
        self,
        query: Query,
        fits: Fits,
        image_of: Callable[[int], UInt8[np.ndarray, "m m"]],
        *,
        possible: Bool[np.ndarray, "*k"] = EVERY,
    ) -> list[Candidate]:
        """Choose the match of a query, and collect the evidence. The list is empty if nothing fits.

        If another scan fits better, but contradicts the motion, it is a second candidate. It can show that the motion
        is wrong.

        Arguments:
          query: The scan.
          fits: Its fits.
          image_of: Function that returns the image of a frame.
          possible: Whether each fit may be a match, beside the scans of the query's own pass.
        """
        best, any_best = self.best(query.frame, fits, possible), self._highest(query.frame, fits, possible)
        chosen = [row for row in dict.fromkeys((best, any_best)) if row is not None]
        high = [row for row in chosen if fits.peaks.correlation[row] >= self.config.min_correlation]
        return [self.candidate(query, fits, row, image_of) for row in high]

    def candidate(
        self, query: Query, fits: Fits, row: int, image_of: Callable[[int], UInt8[np.ndarray, "m m"]]
    ) -> Candidate:
        """Collect the evidence of one fit.

        The poses of other scans that the motion excludes count against it. So do second-best poses, those of the match
        and of scans whose best poses the motion allows.
        """
        match, peak = int(fits.frames[row]), fits.peaks.one(row)
        deviation = float(self._deviations(query.frame, fits)[row])
        distracts = self._excluded(query.frame, match, peak, fits)
        if deviation <= self.drift.max_deviation:
            contradicts = self._deviations(query.frame, fits) > self.drift.max_deviation
            distracts |= contradicts & ~self.are_joined(match, fits.frames)
        distracts &= fits.frames != match
        others = np.where(distracts, fits.peaks.correlation, fits.peaks.second)
        ambiguity = float(others.max()) / max(float(peak.correlation), 1e-6)
        alignment = jax.device_get(refined(query.image, image_of(match), peak, config=self.verification))
        evidence = Evidence.of(ambiguity, alignment.along_m, deviation, self.surprise(query.frame, match))
        return Candidate(query.frame, match, alignment, evidence)

    def surprise(self, query: int, match: int) -> float:
        """Logarithm of all poses that a sensor may have over those within the uncertainty of the motion.

        A lookalike stands anywhere in the surroundings. Its rotation is one of `SYMMETRIES`, because walls stand at
        right angles. The result is negative if the motion allows more positions than the surroundings have.
        """
        spread = planar_spread(self.motion.path, np.array([query]), np.array([match]), drift=self.drift)[0]
        area = 2 * np.pi * np.sqrt(np.linalg.det(spread[:2, :2]))
        rotation = max(2 * self.drift.max_deviation * np.sqrt(spread[2, 2]), 2 * np.pi / SYMMETRIES)
        return float(np.log(SURROUNDINGS_M**2 / area) + max(np.log(2 * np.pi / rotation), 0))

    def _highest(self, query: int, fits: Fits, allowed: Bool[np.ndarray, "*k"]) -> int | None:
        """The flagged fit with the highest correlation, not of the query's own pass."""
        flags = allowed & (self.way_m(fits.frames, query) >= self.config.recent_m)
        return int(np.argmax(np.where(flags, fits.peaks.correlation, -1.0))) if flags.any() else None

    def _deviations(self, query: int, fits: Fits) -> Float[np.ndarray, " k"]:
        return self.deviations(query, fits.frames, _planar(fits.peaks))

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

    def _cohort(self, query: Query, match: int, store: Stored) -> Fits:
        """Compare a query with the scans most like it that show another place than the query or the match, and with
        those near enough to contradict the motion by their fit."""
        config, frames = self.config, store.frames
        ways = np.stack([self.way_m(frames, frame) for frame in (query.frame, match)])
        beside = (ways >= config.beside_m).all(axis=0)
        other = self.elsewhere(frames, query.frame) | self.elsewhere(frames, match)
        near = (ways < 2 * config.recent_m).any(axis=0) & ~other
        found = []
        for count, exact, flags in (
            (config.cohort, config.exact_cohort, other & beside),
            (config.near_cohort, config.exact_near_cohort, near & beside),
        ):
            rows = store.nearest(query.descriptor, count, flags)
            order = np.argsort(-self.coarse(query.spectra, store.spectra(rows)), kind="stable")
            found.append(self._compared(query, store, rows[order[:exact]]))
        return _joined(*found)

    def _compared(self, query: Query, store: Stored, rows: Int[np.ndarray, " k"]) -> Fits:
        """Compare the images of a query and of some stored scans at all rotations and shifts."""
        return Fits(store.frames[rows], self.search(query.spectra, store.spectra(rows)))

    def _excluded(self, query: int, match: int, peak: Peak, fits: Fits) -> Bool[np.ndarray, " k"]:
        """Whether the motion between the match and each scan excludes that the query fits both."""
        query_from_match = inverted(np.array([float(peak.x), float(peak.y), float(peak.yaw)]))
        others = compose(_planar(fits.peaks), query_from_match)
        excludes = self.deviations(match, fits.frames, others) > self.drift.max_deviation
        return excludes & ~self.are_joined(match, fits.frames)

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

    def coarse(
        self, spectra: Spectra | None, matches: Sequence[Complex64[np.ndarray, "s f"]]
    ) -> Float[np.ndarray, " k"]:
        """Highest correlation with each match by the coarse comparison."""
        if not matches or spectra is None:
            return np.zeros(0)
        stacked = batched(matches, COARSE_BATCH)
        found = coarse_correlations(spectra, stacked, len(matches), config=self.verification)
        return np.asarray(found)[: len(matches)]

    def search(self, spectra: Spectra | None, matches: Sequence[Complex64[np.ndarray, "s f"]]) -> Peak:
        """Poses of a query in the frames of some matches."""
        if not matches or spectra is None:
            return NO_PEAKS
        found = search_spectra(spectra, batched(matches, BATCH), len(matches), config=self.verification)
        return jax.device_get(found).some(slice(len(matches)))


def _planar(found: Peak) -> Planar:
    return np.stack([np.asarray(values, np.float64) for values in (found.x, found.y, found.yaw)], axis=-1)


def _joined(*fits: Fits) -> Fits:
    frames, peaks = zip(*fits, strict=True)
    return Fits(np.concatenate(frames), Peak(*map(np.concatenate, zip(*peaks, strict=True))))


def batched(matches: Sequence[Complex64[np.ndarray, "s f"]], multiple: int) -> Complex64[np.ndarray, "k s f"]:
    """Stack spectra, and pad them to a multiple of a number, because each size compiles its own program."""
    found = np.zeros((-(-len(matches) // multiple) * multiple, *matches[0].shape), np.complex64)
    found[: len(matches)] = matches
    return found
