"""Candidate matches of a scan: description, retrieval of earlier scans, and comparison of images."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Float32, Int, Num, UInt8

from sglpr_jax.bev import centre_crop, even_cells
from sglpr_jax.data.density_grid import MAX_COUNT
from sglpr_jax.data.mounting import Mounting
from sglpr_jax.data.record import Record
from sglpr_jax.data.views import check_ready_made, image_view, picture, view
from sglpr_jax.loops.background import Background
from sglpr_jax.loops.config import CandidateConfig, DriftModel, VerificationConfig
from sglpr_jax.loops.drift import position_deviations
from sglpr_jax.loops.given import check_is
from sglpr_jax.loops.motion import Motion
from sglpr_jax.loops.pose_search import NO_PEAKS, Peak, occupied, query_spectra, search_spectra, within_reach
from sglpr_jax.loops.probability import Evidence
from sglpr_jax.loops.rivals import distance_share, expected_poses, rival_share, rivals
from sglpr_jax.loops.transforms import inverse, transform
from sglpr_jax.loops.upright import upright_from_lidar
from sglpr_jax.loops.verification import Alignment, refined
from sglpr_jax.models.params import Params
from sglpr_jax.models.sglpr import describe
from sglpr_jax.models.weights import weights_hash
from sglpr_jax.retrieval.index import Index


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


class Seen(NamedTuple):
    """Descriptor and image of a scan or ready-made image."""

    descriptor: Float32[np.ndarray, " d"]
    image: UInt8[np.ndarray, "n n"]
    """Density image."""
    mounting: Mounting | None
    """Mounting of the sensor. Descriptor and image are gravity-aligned."""


class CandidateFinder:
    """Finds candidates in a stream of scans. Stores descriptor and image of each scan."""

    def __init__(
        self,
        params: Params,
        *,
        config: CandidateConfig = CandidateConfig(),
        verification: VerificationConfig = VerificationConfig(),
        drift: DriftModel = DriftModel(),
    ):
        check_is(params, Params, by="load")
        if params.config.categories_read:
            raise ValueError("expected a model that describes images alone, found one that reads labels too")
        self.params, self.config, self.verification, self.drift = params, config, verification, drift
        self.index = Index.empty(params.config.head.descriptor_size, weights_hash=weights_hash(params))
        self.images: list[UInt8[np.ndarray, "n n"]] = []
        self.details: list[UInt8[np.ndarray, "m m"]] = []
        """Centre of each image without the background, for comparison."""
        self.odometry: list[Float[np.ndarray, "4 4"]] = []
        self.mounting: Mounting | None = None
        """Mounting of the sensor, the same for all frames."""
        self.empty: list[bool] = []
        """Whether each frame is almost empty (`is_empty`)."""
        self.motion = Motion(config.motion)
        self.background = Background(frames=config.background_frames, least=config.min_background_frames)
        self.links: list[Peak | None] = []
        """Pose of each frame in the frame of its keyframe, if there is no odometry."""
        self.missing: list[int] = []
        """Frames whose scans cannot be read."""

    def add(
        self, record: Record, *, time: float | None = None, odometry: Float[np.ndarray, "4 4"] | None = None
    ) -> list[Candidate]:
        """Describe a scan or image, add it, and return its candidate, or an empty list.

        Arguments:
          record: The scan or image.
          time: Time of the scan, in seconds.
          odometry: Pose of the LiDAR in any fixed frame.

        Raises:
          ValueError: If only some frames have a time or a pose, if times decrease, or if the mounting changes.
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
        if seen is None:
            self.missing.append(len(self.index))
            seen = Seen(np.zeros(self.index.width, np.float32), np.zeros((0, 0), np.uint8), self.mounting)
        pose = None if odometry is None else np.asarray(odometry, np.float64)
        position = None if pose is None else pose[:3, 3]
        clock = len(self.index) * self.config.exclude_s / max(self.config.exclude_frames, 1) if time is None else time
        upright = None if pose is None else pose @ inverse(upright_from_lidar(seen.mounting))
        middle = np.asarray(within_reach(seen.image, self.verification)) if seen.image.size else seen.image
        detail, keyframe = self.background.without(middle), self.motion.keyframe
        if compared is None:
            compared = self._compared(seen._replace(image=detail), time, position, upright, clock)
        else:
            self.motion.add(clock, pose=upright, link=compared.link)
        if middle.size and (self.motion.keyframe != keyframe or not self.images):
            self.background.add(middle)
        self.index.add(seen.descriptor, times=time, positions=position)
        self.images.append(seen.image)
        self.details.append(detail)
        self.empty.append(self.is_empty(seen.image))
        self.links.append(compared.link)
        self.mounting = seen.mounting
        if pose is not None:
            self.odometry.append(pose)
        return compared.candidates

    def seen(self, record: Record) -> Seen:
        """Descriptor and 8-bit density image of a scan or image. Nothing is stored."""
        model = self.params.config
        check_ready_made(record, model.image)
        whole, _ = picture(record, None)
        if record.points is None or model.image == "density":
            bev = image_view(whole, None, model.grid).image
        else:
            bev = view(record, model.grid, image=model.image).image
        return Seen(np.asarray(describe(self.params, bev)), _kept(whole), record.mounting)

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
        rows = self._rows(seen.descriptor, self._excluded(time, position))
        key = self.motion.keyframe
        linked = pose is None and len(self.details) > 0 and not self.empty[key]
        matches = [self.details[row] for row in ([*rows, key, key] if linked else rows)]
        priors = np.full((len(matches), 3), np.nan)
        if linked:
            priors[-1] = self.motion.prior(clock)
        spectra = query_spectra(seen.image, config=self.verification)
        peaks = self.search(spectra, matches, self.config.candidates + self.config.elsewhere + 2 * linked, priors)
        link = self.motion.link(peaks.one(len(rows)), peaks.one(len(rows) + 1)) if linked else None
        self.motion.add(clock, pose=pose, link=link)
        if not len(rows):
            return Compared([], link)
        best = int(np.argmax(peaks.correlation[: len(rows)]))
        return Compared([self._candidate(seen, spectra, rows, peaks.some(slice(len(rows))), best)], link)

    def _rows(self, descriptor: Float32[np.ndarray, " d"], excluded: Bool[np.ndarray, " n"]) -> Int[np.ndarray, " k"]:
        """Frames with the nearest descriptors, and frames with the nearest descriptors at other times than the
        first.
        """
        rows = self.nearest(descriptor, self.config.candidates, excluded)
        if not len(rows):
            return rows
        excluded = excluded | self.motion.about(int(rows[0]), self.config.rivals.age[0] * self.config.exclude_s)
        return np.concatenate([rows, self.nearest(descriptor, self.config.elsewhere, excluded)])

    def nearest(
        self, descriptor: Float32[np.ndarray, " d"], k: int, excluded: Bool[np.ndarray, " n"]
    ) -> Int[np.ndarray, " j"]:
        """Up to k frames with the nearest descriptors, nearest first."""
        rows = self.index.query(descriptor, k, exclude=excluded).rows
        return rows[rows >= 0]

    def _candidate(
        self, seen: Seen, spectra: Complex[Array, "s t f"], compared: Int[np.ndarray, " k"], peaks: Peak, best: int
    ) -> Candidate:
        """Candidate of the best compared frame. Compared frames that are known to show another place are rivals."""
        match, peak = int(compared[best]), peaks.one(best)
        distance = float(np.linalg.norm(self.index.descriptors[match] - seen.descriptor))
        alignment = jax.device_get(refined(seen.image, self.details[match], peak, config=self.verification))
        shares = np.nan, np.nan
        if peak.correlation >= self.config.min_rival_correlation:
            usable, exclude_s = ~np.array(self.empty, bool), self.config.exclude_s
            rules, known = self.config.rivals, self.index.descriptors
            rows = rivals(seen.descriptor, known, match, self.motion, usable, exclude_s=exclude_s, config=rules)
            found = self.search(spectra, [self.details[row] for row in rows], rules.of_query + rules.of_match)
            by_motion = expected_poses(self.motion, len(self.index), rows, np.eye(4), config=rules)
            shares = self._shares(seen, match, distance, peak, rows, found, [by_motion])
            far = ~self.motion.about(match, rules.age[0] * exclude_s)[compared] & self.motion.same(match, compared)
            elsewhere = self._shares(seen, match, distance, peak, compared[far], peaks.some(far), [])
            shares = np.fmax(shares, elsewhere)
        cells = min(occupied(image, self.verification) for image in (seen.image, self.details[match]))
        evidence = Evidence.of(distance, shares[0], alignment.correlation, alignment.second, shares[1], cells)
        return Candidate(len(self.index), match, alignment, evidence)

    def _shares(
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
        expected = [*expected, expected_poses(self.motion, match, rows, match_from_query, config=rules)]
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
        if not len(self.index):
            return
        if seen is not None and seen.mounting != self.mounting and len(self.missing) < len(self.index):
            raise ValueError(f"expected one sensor mounting for all frames, {self.mounting}, found {seen.mounting}")
        for name, given, known in (
            ("a time", time is not None, self.index.times is not None),
            ("odometry", odometry is not None, bool(self.odometry)),
        ):
            if given != known:
                raise ValueError(f"expected {name} for every frame or for none, found both (frame {len(self.index)})")
        if time is not None and self.index.times is not None and time < self.index.times[-1]:
            raise ValueError(f"expected times that do not decrease, found {time} after {self.index.times[-1]}")

    def _excluded(self, time: float | None, position: Float[np.ndarray, " 3"] | None) -> Bool[np.ndarray, " n"]:
        """Frames that cannot match the next one: too recent, almost empty, or too far away by odometry."""
        config, known = self.config, self.index.positions
        excluded = self.index.recent(time, seconds=config.exclude_s, frames=config.exclude_frames)
        excluded = excluded | np.array(self.empty, bool) | self.motion.near_last(config.min_travelled_m)
        if position is not None and known is not None and len(known):
            drifted = position_deviations(np.concatenate([known, position[None]]), -1, drift=self.drift)[:-1]
            apart = np.linalg.norm(known - position, axis=1)
            place_m = np.sqrt(2) * self.verification.max_shift_m  # largest shift along x and y
            excluded = excluded | (apart > place_m + self.drift.max_deviation * drifted)
        return excluded


def _kept(image: Num[np.ndarray, "h w"]) -> UInt8[np.ndarray, "n n"]:
    """Central square of an image, with an even number of cells, as 8 bits."""
    even = even_cells(jnp.asarray(image, jnp.float32))
    size = min(even.shape)
    grey = np.asarray(centre_crop(even, height=size, width=size)) * (255 / MAX_COUNT)
    return np.round(grey).clip(0, 255).astype(np.uint8)


def square_image(record: Record) -> UInt8[np.ndarray, "n n"]:
    """Image for the verification of loops: the density image or the ready-made image, as 8 bits."""
    return _kept(picture(record, None)[0])
