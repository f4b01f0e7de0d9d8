"""Candidate matches of the scans of a stream: each scan is described, compared with earlier scans, and stored."""

import dataclasses

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from sglpr_jax.data.mounting import Mounting, is_tilted, upright_from_lidar
from sglpr_jax.data.scan import Scan
from sglpr_jax.fields import check_is
from sglpr_jax.growing import GrowingArray
from sglpr_jax.loops.closure import LoopClosure, renumbered, to_lidar, to_upright
from sglpr_jax.loops.comparison import NO_FITS, Candidate, Fits, KeyframeComparison, Query
from sglpr_jax.loops.config import MIN_CELLS, DetectorConfig
from sglpr_jax.loops.keyframes import Keyframe, StoredScans, describe_scan
from sglpr_jax.models.weights import Params, weights_hash
from sglpr_jax.odometry.bev_odometry import MIN_EXPECTED, BevOdometry
from sglpr_jax.odometry.drift_check import OdometryCheck
from sglpr_jax.odometry.drift_model import MOTION_DRIFT, DriftModel
from sglpr_jax.registration.background import Background
from sglpr_jax.registration.bev_alignment import BevRegistration, refine
from sglpr_jax.registration.bev_search import NO_PRIOR, CorrelationPeak, search_near
from sglpr_jax.registration.bev_spectra import within_reach
from sglpr_jax.retrieval.index import Index
from sglpr_jax.se3 import inverse, yaw_of

KEYFRAME_DEG = 20.0
"""Rotation from the last frame at which a scan is the next frame at any distance, in degrees."""
DISTINCT = 0.4
"""Coarse correlation with scans of other places below which a place is distinct. Most places of towns are; rows of
equal houses, aisles and parking spaces are not."""
FLAT_M = 1e-6
"""Maximum difference in height of odometry that does not measure height, in metres."""
AGREE_M, AGREE_DEG = 0.8, 6.0
"""Maximum distance and angle between two estimates of a pose that agree, in metres and degrees."""


def agree(pose: Float[np.ndarray, "4 4"], other: Float[np.ndarray, "4 4"]) -> bool:
    """Whether two poses in a level frame are at most `AGREE_M` and `AGREE_DEG` apart, without their heights."""
    apart_m, turned = np.linalg.norm((other - pose)[:2, 3]), yaw_of(other @ inverse(pose))
    return bool(apart_m <= AGREE_M and abs(np.degrees(turned)) <= AGREE_DEG)


class CandidateSearch:
    """Finds candidates in a stream of scans, and stores descriptor and compressed image of the scans.

    Only keyframes are added, which are some metres apart (`is_due`). The scans between them are skipped. Frames are
    numbered in the order in which they are added, and loops that leave the search get the numbers of their scans.
    Almost empty frames, and frames close to the last stored one, are not stored. Each frame takes a constant number of
    image comparisons, and a matrix product for the nearest descriptors.
    """

    def __init__(self, params: Params, config: DetectorConfig = DetectorConfig()):
        """Start without frames. Raises TypeError or ValueError if the model is not one that describes images alone."""
        check_is(params, Params, by="load")
        if params.config.categories_read:
            raise ValueError("expected a model that describes images alone, found one that reads labels too")
        self.params, self.config, self.verification = params, config.candidates, config.verification
        self.drift, self._keyframe_m = config.drift, config.keyframe_m
        self.scans = 0
        """Number of scans so far: the added frames and the skipped scans."""
        self._rows = GrowingArray(np.empty(0, np.int64))
        index = Index.empty(params.config.head.descriptor_size, weights_hash=weights_hash(params))
        self.stored = StoredScans(index, verification=config.verification, max_places=config.max_places)
        """Descriptors, and central parts of the images without the background, of the stored scans."""
        self.fits = NO_FITS
        """Comparisons of the last frame."""
        self.has_odometry = False
        self._heights_m = np.inf, -np.inf  # lowest and highest position of the LiDAR by odometry
        """Whether the frames have poses from odometry. If so, `motion` holds them."""
        self.motion = BevOdometry()
        """Motion of the sensor over all frames."""
        self.mountings: list[Mounting | None] = []
        """Mounting of the sensor at each frame."""
        self.missing: list[int] = []
        """Frames whose scans cannot be read."""
        self.loops = GrowingArray(np.empty((0, 2), np.int64))
        """Frames of the query and the match of each accepted loop."""
        self.odometry_check = OdometryCheck()
        self.background = Background()
        self._empty = GrowingArray(np.empty(0, bool))
        self._time: float | None = None
        """Time of the last frame, in seconds. None if the frames have no times."""
        self._last: Query | None = None
        """The last frame that is not almost empty."""
        self._reference: Query | None = None
        """The last reference of the motion that is not almost empty."""
        self._checked: Query | None = None
        """The last frame that was used to check the odometry."""

    def __len__(self) -> int:
        """Number of added frames."""
        return len(self._empty)

    @property
    def rows(self) -> Int[np.ndarray, " n"]:
        """Number of the scan of each frame, counted from 0 with the skipped scans."""
        return self._rows.rows

    def segments_of(self, scans: Int[np.ndarray, " k"]) -> Int[np.ndarray, " k"]:
        """Number of the segment of the motion of each scan. A skipped scan is in the segment of the frame before it."""
        return self.motion.segments[np.searchsorted(self.rows, scans, side="right") - 1]

    @property
    def index(self) -> Index:
        """Descriptors of the stored scans. Their frames are `stored.frames`."""
        return self.stored.index

    @property
    def empty(self) -> Bool[np.ndarray, " n"]:
        """Whether each frame is almost empty: its image has fewer than `MIN_CELLS` occupied cells."""
        return self._empty.rows

    @property
    def nbytes(self) -> int:
        """Number of bytes of all frames: descriptors, compressed images and poses."""
        return sum(array.nbytes for array in (self.stored, self.motion, self._empty))

    @property
    def present_drift(self) -> DriftModel:
        """Drift of the odometry or, without odometry, of the motion estimated from the images."""
        return self.odometry_check.drift(self.drift) if self.has_odometry else MOTION_DRIFT

    @property
    def knows_height(self) -> bool:
        """Whether there is odometry that measures height. That of wheels does not."""
        lowest_m, highest_m = self._heights_m
        return self.has_odometry and highest_m - lowest_m > FLAT_M

    def keyframe(self, scan: Scan) -> Keyframe:
        """Compute descriptor and 8-bit density image of a scan or image (`describe_scan`). Nothing is stored."""
        return describe_scan(self.params, scan)

    def to_upright(self, loop: LoopClosure) -> LoopClosure:
        """Convert a loop of two scans, between their LiDAR frames, to one of two frames, gravity-aligned."""
        query, match = np.searchsorted(self.rows, [loop.query, loop.match]).tolist()
        loop = dataclasses.replace(loop, query=query, match=match)
        return to_upright(loop, query=self.mountings[query], match=self.mountings[match])

    def to_lidar(self, loop: LoopClosure) -> LoopClosure:
        """Convert a loop of two frames, gravity-aligned, to one of two scans, between their LiDAR frames."""
        loop = to_lidar(loop, query=self.mountings[loop.query], match=self.mountings[loop.match])
        return renumbered(loop, [self.rows])

    def close_loop(self, query: int, match: int) -> None:
        """Store an accepted loop between two frames."""
        self.loops.append((query, match))
        self.stored.close_loop(query, match)

    @property
    def spacing_m(self) -> float:
        """Distance between frames in metres: `keyframe_m`, or a fifth of it where places look alike, or may.

        There, images of one place, taken apart, differ as much as those of two places, and many frames are needed.
        """
        return self._keyframe_m if self.fits.lookalike < DISTINCT else self._keyframe_m / 5

    def is_due(
        self,
        *,
        time: float | None = None,
        odometry: Float[np.ndarray, "4 4"] | None = None,
        continues: bool = True,
    ) -> bool:
        """Whether the next scan should be a frame: the sensor moved `spacing_m` or turned since the last one.

        Without odometry, the motion since the last frame is extrapolated, so a standing sensor may move off unnoticed.
        A scan is therefore also due if the sensor, at its highest speed so far, could have moved too far to be found.
        Until it moves for the first time, its speed is unknown, and every scan is due.
        Raises the ValueError of `add_keyframe`.
        """
        self._check_order(time, odometry)
        if not len(self) or not self.spacing_m or not continues:
            return True
        if odometry is not None:
            pose = np.asarray(odometry, np.float64) @ inverse(upright_from_lidar(self.mountings[-1]))
        else:
            time = self._time_of_scan(time)
            pose = self.motion.extrapolated(time)
            may_be_far = self.motion.most_moved_m(time) >= self.verification.max_shift_m / 2
            if pose is None or may_be_far or self.motion.travelled[-1] < self.spacing_m:
                return True
        moved_m, rotation = self.motion.moved(len(self) - 1, pose)
        return bool(moved_m >= self.spacing_m or rotation >= np.radians(KEYFRAME_DEG))

    def pose_by_image(self, keyframe: Keyframe, *, time: float) -> Float[np.ndarray, "4 4"] | None:
        """Pose of the LiDAR at the next scan by registration with the last frames, in the frame of the odometry.

        None if the images do not show it. The scan is not added.
        """
        if not len(self) or np.count_nonzero(keyframe.image) < MIN_CELLS:
            return None
        image = self.background.without(np.asarray(within_reach(keyframe.image, self.verification)))
        link = self._register_with_reference(Query(len(self), keyframe.descriptor, image, self.verification), time)
        if link is None:
            return None
        upright_pose = self.motion.poses[self.motion.reference] @ link.match_from_query
        return upright_pose @ upright_from_lidar(keyframe.mounting)

    def skip(self) -> None:
        """Count a scan that is not a frame."""
        self.scans += 1

    def _time_of_scan(self, time: float | None) -> float:
        """Time of the next scan in seconds or, without times, its number."""
        return float(self.scans) if time is None else time

    def add_keyframe(
        self,
        keyframe: Keyframe | None,
        *,
        time: float | None = None,
        odometry: Float[np.ndarray, "4 4"] | None = None,
        fits: Fits | None = None,
        continues: bool = True,
    ) -> list[Candidate]:
        """Add the next frame, and return its candidates: at most two, mostly one or none.

        Arguments:
          keyframe: Descriptor and image, or None for a scan that cannot be read.
          time: Time of the scan, in seconds. By default, scans are one second apart.
          odometry: Pose of the LiDAR in any fixed frame.
          fits: Comparisons of an earlier run (`loops.checkpoint`), which are then not repeated.
          continues: See `LoopDetector.add`.

        Raises:
          ValueError: If only some frames have a time or a pose, or if times decrease.
        """
        self._check_order(time, odometry)
        frame = len(self)
        if keyframe is None:
            self.missing.append(frame)
            mounting = self.mountings[-1] if self.mountings else None
            keyframe = Keyframe(np.zeros(self.index.width, np.float32), np.zeros((0, 0), np.uint8), mounting)
        image = np.asarray(within_reach(keyframe.image, self.verification)) if keyframe.image.size else keyframe.image
        is_empty = bool(np.count_nonzero(keyframe.image) < MIN_CELLS)
        if not is_empty:
            self.stored.check(frame, image)
        foreground = self.background.without(image)
        query = None if is_empty else Query(frame, keyframe.descriptor, foreground, self.verification)
        previous_reference = self.motion.reference
        link = self._add_motion(query, keyframe.mounting, time, odometry, fits, continues=continues)
        comparer = KeyframeComparison(self.motion, self.present_drift, self.config, self.verification, self.loops.rows)
        if fits is None:
            fits = (NO_FITS if query is None else comparer.compare(query, self.stored))._replace(link=link)
        candidates = [] if query is None else comparer.candidates(query, fits, self.stored)
        has_moved = self.motion.reference != previous_reference or not frame
        if image.size and has_moved:
            self.background.add(image)
        if query is not None:
            self._last = query
            if self.motion.reference == frame:
                self._reference = query
        if not is_empty and self._is_new_place(frame):
            self.stored.add(frame, keyframe.descriptor, foreground)
        self._empty.append(is_empty)
        self._rows.append(self.scans)
        self.scans += 1
        self._time, self.fits = time, fits
        return candidates

    def _is_new_place(self, frame: int) -> bool:
        """Whether a frame is far enough from the last stored one, or its motion from there is unknown.

        It is if they are half of `spacing_m` apart, because a frame may come early.
        """
        if not self.spacing_m or not len(self.stored):
            return True
        last_frame = int(self.stored.frames[-1])
        moved_m, rotation = self.motion.moved(last_frame, self.motion.poses[frame])
        is_near = moved_m < self.spacing_m / 2 and rotation < np.radians(KEYFRAME_DEG / 2)
        return not (is_near and self.motion.segments[frame] == self.motion.segments[last_frame])

    def _check_order(self, time: float | None, odometry: Float[np.ndarray, "4 4"] | None) -> None:
        """Raise ValueError if some frames have a time or odometry and others have none, or if times decrease."""
        if not len(self):
            return
        for name, is_given, is_expected in (
            ("a time", time is not None, self._time is not None),
            ("odometry", odometry is not None, self.has_odometry),
        ):
            if is_given != is_expected:
                raise ValueError(f"expected {name} for every frame or for none, found both (frame {len(self)})")
        if time is not None and self._time is not None and time < self._time:
            raise ValueError(f"expected times that do not decrease, found {time} after {self._time}")

    def _add_motion(
        self,
        query: Query | None,
        mounting: Mounting | None,
        time: float | None,
        odometry: Float[np.ndarray, "4 4"] | None,
        fits: Fits | None,
        *,
        continues: bool,
    ) -> BevRegistration | None:
        """Add the motion up to the next frame. Returns the registration that shows it, or None.

        With odometry, the frame is registered with the last frame that was used to check the odometry, otherwise with
        the reference of the motion. Comparisons of an earlier run (`fits`) contain the registration.
        """
        link = None if fits is None else fits.link
        to_upright = upright_from_lidar(mounting)
        pose = None if odometry is None else np.asarray(odometry, np.float64) @ inverse(to_upright)
        time = self._time_of_scan(time)
        self.has_odometry = pose is not None
        if odometry is not None:  # without the mounting, whose height may be estimated for each scan
            height_m, (lowest_m, highest_m) = float(odometry[2, 3]), self._heights_m
            self._heights_m = min(lowest_m, height_m), max(highest_m, height_m)
        if not continues:
            self.odometry_check.restart()
        if pose is not None:
            link = self._check_odometry(query, pose, link, is_known=fits is not None)
        elif fits is None and continues:
            link = self._register_with_reference(query, time)
        self.motion.add(time, pose=pose, link=link, continues=continues)
        self.motion.path.tilted |= is_tilted(to_upright)
        self.mountings.append(mounting)
        return link

    def _check_odometry(
        self, query: Query | None, pose: Float[np.ndarray, "4 4"], link: BevRegistration | None, *, is_known: bool
    ) -> BevRegistration | None:
        """Compare the odometry with the images, if this is due. Returns the registration with the last compared scan.

        The registration `link` of an earlier run (`is_known`) is not repeated.
        """
        if query is None or not self.odometry_check.is_due(pose):
            return None
        if not is_known and self._checked is not None:
            link, _ = self._register(query, self._checked, NO_PRIOR)
        self.odometry_check.add(pose, link)
        self._checked = query
        return link

    def _register_with_reference(self, query: Query | None, time: float) -> BevRegistration | None:
        """Pose of the next frame in the frame of the motion's reference, or None if the images do not show it.

        The image is registered with that of the reference and, if this is ambiguous, with that of the last frame. Two
        ambiguous poses that agree are trusted, too. If the images show the position in one direction only, the sensor
        is assumed to move on as before.
        """
        if query is None:
            return None
        links, along_ridge = list[BevRegistration](), None
        segments = self.motion.segments
        frames = [each for each in (self._reference, self._last) if each is not None]
        known = {each.frame: each for each in frames if segments[each.frame] == segments[-1]}
        for reference in known.values():
            prior = self.motion.prior(time, reference.frame)
            best, expected = self._register(query, reference, prior)
            if self.motion.is_trusted(best, prior):
                return self._from_reference(best, reference.frame)
            fits_expected = expected.correlation >= MIN_EXPECTED * best.correlation
            if self.motion.is_ridge(best) and fits_expected and np.isfinite(prior).all():
                x, y, yaw = prior
                along_ridge = self._from_reference(best._replace(x=x, y=y, yaw=yaw), reference.frame)
            links.append(self._from_reference(expected, reference.frame))
        if len(links) == 2 and not any(map(self.motion.is_ridge, links)):
            first, second = links
            if agree(first.match_from_query, second.match_from_query):
                return first
        return along_ridge

    def _register(
        self, query: Query, reference: Query, prior: Float[np.ndarray, " 3"]
    ) -> tuple[BevRegistration, BevRegistration]:
        """Best pose of a query in the frame of a reference, and best pose near `prior`. Equal with `NO_PRIOR`."""
        peaks = jax.device_get(search_near(query.spectra, reference.own_spectrum, prior, config=self.verification))
        best = self._refine(query, reference, peaks.at(0))
        if np.isnan(prior).any() or peaks.correlation[0] == peaks.correlation[1]:
            return best, best
        return best, self._refine(query, reference, peaks.at(1))

    def _refine(self, query: Query, reference: Query, peak: CorrelationPeak) -> BevRegistration:
        """Register the image of a query with that of a reference, near a peak of the search."""
        return jax.device_get(refine(query.image, reference.image, peak, config=self.verification))

    def _from_reference(self, link: BevRegistration, frame: int) -> BevRegistration:
        """Convert a registration with an earlier frame to one with the motion's reference."""
        reference, poses = self.motion.reference, self.motion.poses
        if frame == reference:
            return link
        reference_from_query = inverse(poses[reference]) @ poses[frame] @ link.match_from_query
        return link._replace(
            x=reference_from_query[0, 3], y=reference_from_query[1, 3], yaw=yaw_of(reference_from_query)
        )
