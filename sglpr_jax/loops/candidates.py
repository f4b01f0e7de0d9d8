"""Candidate matches of a scan: description, retrieval of earlier scans, and comparison of images."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Float32, Int, UInt8

from sglpr_jax.data.mounting import Mounting
from sglpr_jax.data.record import Record
from sglpr_jax.growing import GrowingArray
from sglpr_jax.loops.background import Background
from sglpr_jax.loops.config import CandidateConfig, DriftModel, VerificationConfig
from sglpr_jax.loops.drift import on_other_floor, position_deviations
from sglpr_jax.loops.given import check_is
from sglpr_jax.loops.motion import Motion
from sglpr_jax.loops.mountings import Mountings, upright_from_lidar
from sglpr_jax.loops.pose_search import NO_PEAKS, Peak, occupied, query_spectra, search_spectra, within_reach
from sglpr_jax.loops.probability import Evidence
from sglpr_jax.loops.rivals import distance_share, expected_poses, rival_share, rivals
from sglpr_jax.loops.seen import Seen, described
from sglpr_jax.loops.shortlist import shortlist
from sglpr_jax.loops.stored_scans import StoredScans
from sglpr_jax.loops.trajectory import Trajectory
from sglpr_jax.loops.transforms import inverse, transform
from sglpr_jax.loops.verification import Alignment, refined
from sglpr_jax.models.params import Params
from sglpr_jax.models.weights import weights_hash
from sglpr_jax.retrieval.index import Index
from sglpr_jax.revisits import are_recent


class Candidate(NamedTuple):
    """Two scans that may show one place."""

    query: int
    match: int
    """Frame numbers, counted from 0. The match is the earlier frame."""
    alignment: Alignment
    """Pose of the query's image in the frame of the match's image."""
    evidence: Evidence


class Compared(NamedTuple):
    """The results of all image comparisons of a frame."""

    candidates: list[Candidate]
    """The candidate of the frame, or an empty list."""
    link: Peak | None
    """Pose in the frame of the keyframe, from which the motion without odometry is computed."""


class CandidateFinder:
    """Finds candidates in a stream of scans. Stores descriptor and compressed image of each scan that is not empty.

    The number of image comparisons for a frame is constant. The search for the nearest descriptor (a matrix product) is
    proportional to the number of stored scans. Times, motion and drift are compared with those of all frames.
    """

    def __init__(
        self,
        params: Params,
        *,
        config: CandidateConfig = CandidateConfig(),
        verification: VerificationConfig = VerificationConfig(),
        drift: DriftModel = DriftModel(),
        keyframe_m: float = 0.0,
        max_places: int | None = None,
    ):
        """Create a finder without frames. The arguments are those of `DetectorConfig`."""
        check_is(params, Params, by="load")
        if params.config.categories_read:
            raise ValueError("expected a model that describes images alone, found one that reads labels too")
        self.params, self.config, self.verification, self.drift = params, config, verification, drift
        index = Index.empty(params.config.head.descriptor_size, weights_hash=weights_hash(params))
        self.stored = StoredScans(index, keyframe_m=keyframe_m, max_places=max_places)
        """Descriptors, and centres of the images without the background, for comparison."""
        self.compared = Compared([], None)
        """Comparisons of the last frame."""
        self.odometry = Trajectory()
        """Poses of all frames from odometry. Empty if there is no odometry."""
        self.mountings = Mountings()
        """Mounting of the sensor at each frame."""
        self._empty = GrowingArray(np.empty(0, bool))
        self.motion = Motion(config.motion)
        self.background = Background(frames=config.background_frames, least=config.min_background_frames)
        self.missing: list[int] = []
        """Frames whose scans cannot be read."""
        self._times = GrowingArray(np.empty(0))
        self._keyframe = np.zeros((0, 0), np.uint8)
        """Image of the keyframe of the motion, as in `stored`."""

    def __len__(self) -> int:
        """Number of added frames."""
        return len(self._empty)

    @property
    def index(self) -> Index:
        """Descriptors of the stored scans. Their frames are `stored.frames`."""
        return self.stored.index

    @property
    def times(self) -> Float[np.ndarray, " n"] | None:
        """Time of each frame in seconds, or None if they have no times."""
        return self._times.rows if len(self._times) else None

    @property
    def _last_mounting(self) -> Mounting | None:
        return self.mountings[len(self) - 1] if len(self) else None

    @property
    def empty(self) -> Bool[np.ndarray, " n"]:
        """Whether each frame is almost empty (`is_empty`)."""
        return self._empty.rows

    @property
    def nbytes(self) -> int:
        """Number of bytes of all frames: descriptors, compressed images, poses and times."""
        arrays = self.stored, self.motion, self.odometry, self._times, self._empty, self.mountings
        return sum(one.nbytes for one in arrays)

    def add(
        self, record: Record, *, time: float | None = None, odometry: Float[np.ndarray, "4 4"] | None = None
    ) -> list[Candidate]:
        """Describe a scan or image, add it, and return its candidate, or an empty list.

        Arguments:
          record: The scan or image.
          time: Time of the scan, in seconds.
          odometry: Pose of the LiDAR in any fixed frame.

        Raises:
          ValueError: If only some frames have a time or a pose, or if times decrease.
        """
        return self.add_seen(self.seen(record), time=time, odometry=odometry)

    def add_seen(
        self,
        seen: Seen | None,
        *,
        time: float | None = None,
        odometry: Float[np.ndarray, "4 4"] | None = None,
        compared: Compared | None = None,
    ) -> list[Candidate]:
        """Add a frame that is already described, and return its candidate. Raises the errors of `add`.

        Arguments:
          seen: Descriptor and image, or None for a scan that cannot be read.
          time: Time of the scan, in seconds.
          odometry: Pose of the LiDAR in any fixed frame.
          compared: Comparisons of an earlier run. If they are given, they are not repeated.
        """
        self._check(seen, time, odometry)
        frame = len(self)
        if seen is None:
            self.missing.append(frame)
            seen = Seen(np.zeros(self.index.width, np.float32), np.zeros((0, 0), np.uint8), self._last_mounting)
        pose = None if odometry is None else np.asarray(odometry, np.float64)
        clock = frame * self.config.exclude_s / max(self.config.exclude_frames, 1) if time is None else time
        upright = None if pose is None else pose @ inverse(upright_from_lidar(seen.mounting))
        middle = np.asarray(within_reach(seen.image, self.verification)) if seen.image.size else seen.image
        empty = self.is_empty(seen.image)
        if not empty:
            self.stored.check(frame, middle)
        detail, keyframe = self.background.without(middle), self.motion.keyframe
        if compared is None:
            position = None if pose is None else pose[:3, 3]
            compared = self._compared(seen._replace(image=detail), time, position, upright, clock)
        else:
            self.motion.add(clock, pose=upright, link=compared.link)
        if middle.size and (self.motion.keyframe != keyframe or not frame):
            self.background.add(middle)
        if self.motion.keyframe == frame:
            self._keyframe = detail
        self._keep(frame, seen, detail, time, pose, empty)
        self.compared = compared
        return compared.candidates

    def _keep(
        self,
        frame: int,
        seen: Seen,
        detail: UInt8[np.ndarray, "m m"],
        time: float | None,
        pose: Float[np.ndarray, "4 4"] | None,
        empty: bool,
    ) -> None:
        """Store what later frames need of a frame."""
        if not empty and self.stored.is_new_place(frame, self.motion):
            self.stored.add(frame, seen.descriptor, detail)
        self._empty.append(empty)
        self.mountings.append(seen.mounting)
        if time is not None:
            self._times.append(time)
        if pose is not None:
            self.odometry.add(pose)

    def seen(self, record: Record) -> Seen:
        """Descriptor and 8-bit density image of a scan or image. Nothing is stored."""
        return described(self.params, record)

    def is_empty(self, image: UInt8[np.ndarray, "n n"]) -> bool:
        """Whether an image has fewer than `min_cells` occupied cells, too few to recognise a place."""
        return bool(np.count_nonzero(image) < self.config.min_cells)

    def _compared(
        self,
        seen: Seen,
        time: float | None,
        position: Float[np.ndarray, " 3"] | None,
        pose: Float[np.ndarray, "4 4"] | None,
        clock: float,
    ) -> Compared:
        """Compare the next frame with its nearest frames and the keyframe, and add it to the motion."""
        if self.is_empty(seen.image):
            self.motion.add(clock, pose=pose)
            return Compared([], None)
        excluded = self._excluded(time, position)
        rows = self.similar(seen.descriptor, excluded)
        key = self.motion.keyframe
        linked = pose is None and len(self) > 0 and not self.empty[key]
        matches = [self.stored.image(row) for row in rows.tolist()] + 2 * linked * [self._keyframe]
        priors = np.full((len(matches), 3), np.nan)
        if linked:
            priors[-1] = self.motion.prior(clock)
        spectra = query_spectra(seen.image, config=self.verification)
        peaks = self.search(spectra, matches, self.config.candidates + self.config.elsewhere + 2 * linked, priors)
        link = self.motion.link(peaks.one(len(rows)), peaks.one(len(rows) + 1)) if linked else None
        self.motion.add(clock, pose=pose, link=link)
        if not len(rows):
            return Compared([], link)
        fit = self.fit if pose is None else self.fit_on_floor
        rows, found = self.with_further(seen, spectra, rows, peaks.some(slice(len(rows))), excluded, fit=fit)
        best = int(np.argmax(fit(rows, found)))
        return Compared([self._candidate(seen, spectra, rows, found, best)], link)

    def similar(self, descriptor: Float32[np.ndarray, " d"], excluded: Bool[np.ndarray, " n"]) -> Int[np.ndarray, " k"]:
        """Stored scans with the nearest descriptors, and those with the nearest ones at other times than the first."""
        rows = self.nearest(descriptor, self.config.candidates, excluded)
        if not len(rows):
            return rows
        excluded = excluded | self.about(int(rows[0]))
        return np.concatenate([rows, self.nearest(descriptor, self.config.elsewhere, excluded)])

    def fit(self, rows: Int[np.ndarray, " k"], found: Peak) -> Float[np.ndarray, " k"]:
        """How well each compared scan fits: its correlation."""
        return found.correlation

    def fit_on_floor(self, rows: Int[np.ndarray, " k"], found: Peak) -> Float[np.ndarray, " k"]:
        """The correlation, and -2 added on another floor by odometry, because floors of a building look alike."""
        other = on_other_floor(self.motion.poses, self.motion.travelled, self.stored.frames[rows], found, self.drift)
        return found.correlation - 2 * other

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
        return self.motion.about(int(frames[row]), self.config.rivals.age[0] * self.config.exclude_s)[frames]

    def nearest(
        self, descriptor: Float32[np.ndarray, " d"], k: int, excluded: Bool[np.ndarray, " n"]
    ) -> Int[np.ndarray, " j"]:
        """Up to k (0 or more) stored scans with the nearest descriptors, nearest first."""
        if not k:
            return np.zeros(0, np.int64)
        rows = self.index.query(descriptor, k, exclude=excluded).rows
        return rows[rows >= 0]

    def _candidate(
        self, seen: Seen, spectra: Complex[Array, "s t f"], compared: Int[np.ndarray, " k"], peaks: Peak, best: int
    ) -> Candidate:
        """Candidate of the best compared scan. Compared scans that are known to show another place are rivals."""
        row, peak, stored = int(compared[best]), peaks.one(best), self.stored
        frames, image = stored.frames, stored.image(row)
        match = int(frames[row])
        distance = float(np.linalg.norm(self.index.descriptors[row] - seen.descriptor))
        alignment = jax.device_get(refined(seen.image, image, peak, config=self.verification))
        shares = np.nan, np.nan
        if peak.correlation >= self.config.min_rival_correlation:
            rules, known = self.config.rivals, self.index.descriptors
            exclude_s = self.config.exclude_s
            rows = rivals(seen.descriptor, known, frames, match, self.motion, exclude_s=exclude_s, config=rules)
            found = self.search(spectra, [stored.image(one) for one in rows.tolist()], rules.of_query + rules.of_match)
            by_motion = expected_poses(self.motion, len(self), frames[rows], np.eye(4), config=rules)
            shares = self.shares(seen, match, distance, peak, rows, found, [by_motion])
            far = ~self.about(row)[compared] & self.motion.same(match, frames[compared])
            elsewhere = self.shares(seen, match, distance, peak, compared[far], peaks.some(far), [])
            shares = np.fmax(shares, elsewhere)
        cells = min(occupied(one, self.verification) for one in (seen.image, image))
        evidence = Evidence.of(distance, shares[0], alignment.correlation, alignment.second, shares[1], cells)
        return Candidate(len(self), match, alignment, evidence)

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
        apart = np.linalg.norm(self.index.descriptors[rows] - seen.descriptor, axis=1)
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

    def _check(self, seen: Seen | None, time: float | None, odometry: Float[np.ndarray, "4 4"] | None) -> None:
        if not len(self):
            return
        for name, given, known in (
            ("a time", time is not None, self.times is not None),
            ("odometry", odometry is not None, len(self.odometry) > 0),
        ):
            if given != known:
                raise ValueError(f"expected {name} for every frame or for none, found both (frame {len(self)})")
        if time is not None and self.times is not None and time < self.times[-1]:
            raise ValueError(f"expected times that do not decrease, found {time} after {self.times[-1]}")

    def _excluded(self, time: float | None, position: Float[np.ndarray, " 3"] | None) -> Bool[np.ndarray, " n"]:
        """Stored scans that cannot match the next frame: too recent, or too far away by odometry."""
        config, frames = self.config, self.stored.frames
        recent = are_recent(len(self), self.times, time, seconds=config.exclude_s, frames=config.exclude_frames)
        excluded = (recent | self.motion.near_last(config.min_travelled_m))[frames]
        if position is not None and len(self.odometry):
            known = self.odometry.poses[:, :3, 3]
            drifted = position_deviations(np.concatenate([known, position[None]]), -1, drift=self.drift)[:-1]
            apart = np.linalg.norm(known[frames] - position, axis=1)
            place_m = np.sqrt(2) * self.verification.max_shift_m  # largest shift along x and y
            excluded = excluded | (apart > place_m + self.drift.max_deviation * drifted[frames])
        return excluded
