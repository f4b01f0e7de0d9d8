"""Candidate matches of the scans of a stream: each scan is described, compared with earlier scans, and stored."""

import jax
import numpy as np
from jaxtyping import Bool, Float, UInt8

from sglpr_jax.data.mounting import Mounting, is_tilted, upright_from_lidar
from sglpr_jax.data.scan import Scan
from sglpr_jax.growing import GrowingArray
from sglpr_jax.loops.arguments import check_is
from sglpr_jax.loops.comparison import NO_FITS, Candidate, Fits, KeyframeComparison, Query
from sglpr_jax.loops.config import MIN_CELLS, DetectorConfig
from sglpr_jax.loops.keyframes import Keyframe, StoredScans, described, image_spectrum
from sglpr_jax.models.params import Params
from sglpr_jax.models.weights import weights_hash
from sglpr_jax.odometry.bev_odometry import MIN_EXPECTED, BevOdometry
from sglpr_jax.odometry.config import MOTION_DRIFT, DriftModel
from sglpr_jax.odometry.drift_check import OdometryCheck
from sglpr_jax.registration.background import Background
from sglpr_jax.registration.bev_alignment import BevRegistration, refined
from sglpr_jax.registration.bev_search import CorrelationPeak, search_near
from sglpr_jax.registration.bev_spectra import query_spectra, within_reach
from sglpr_jax.retrieval.index import Index
from sglpr_jax.se3 import inverse, transform, yaw_of

FLAT_M = 1e-6
"""Maximum difference in height of odometry that does not measure height, in metres."""
AGREE_M, AGREE_DEG = 0.8, 6.0
"""Maximum distance and angle between two poses of a scan in one frame that agree, in metres and degrees."""


class CandidateSearch:
    """Finds candidates in a stream of scans. Stores descriptor and compressed image of each scan that is not empty.

    Each frame takes a constant number of image comparisons, and a matrix product for the nearest descriptors.
    """

    def __init__(self, params: Params, config: DetectorConfig = DetectorConfig()):
        """Create a finder without frames."""
        check_is(params, Params, by="load")
        if params.config.categories_read:
            raise ValueError("expected a model that describes images alone, found one that reads labels too")
        self.params, self.config, self.verification = params, config.candidates, config.verification
        self.drift = config.drift
        index = Index.empty(params.config.head.descriptor_size, weights_hash=weights_hash(params))
        limits = {"keyframe_m": config.keyframe_m, "max_places": config.max_places}
        self.stored = StoredScans(index, verification=config.verification, **limits)
        """Descriptors, and centres of the images without the background, for comparison."""
        self.compared = NO_FITS
        """Comparisons of the last frame."""
        self.has_odometry = False
        """Whether the frames have poses from odometry. If so, `motion` holds them."""
        self.mountings: list[Mounting | None] = []
        """Mounting of the sensor at each frame."""
        self._empty = GrowingArray(np.empty(0, bool))
        self.motion = BevOdometry()
        self.joined = GrowingArray(np.empty((0, 2), np.int64))
        """Frames of the query and the match of each accepted loop."""
        self.background = Background()
        self.missing: list[int] = []
        """Frames whose scans cannot be read."""
        self._times = GrowingArray(np.empty(0))
        self._keyframe: tuple[int, UInt8[np.ndarray, "m m"]] | None = None
        self.odometry_check = OdometryCheck()
        self._checked: UInt8[np.ndarray, "m m"] | None = None
        """Image of the last scan with which the odometry was checked."""
        self._last: tuple[int, UInt8[np.ndarray, "m m"]] | None = None
        """Number and image of the motion's keyframe and of the last frame, as in `stored`. None for empty images."""

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
    def empty(self) -> Bool[np.ndarray, " n"]:
        """Whether each frame is almost empty: it has fewer than `MIN_CELLS` occupied cells."""
        return self._empty.rows

    @property
    def nbytes(self) -> int:
        """Number of bytes of all frames: descriptors, compressed images, poses and times."""
        return sum(one.nbytes for one in (self.stored, self.motion, self._times, self._empty))

    def add_keyframe(
        self,
        keyframe: Keyframe | None,
        *,
        time: float | None = None,
        odometry: Float[np.ndarray, "4 4"] | None = None,
        compared: Fits | None = None,
        continues: bool = True,
    ) -> list[Candidate]:
        """Add a described scan or image, and return its candidate, or an empty list.

        Arguments:
          seen: Descriptor and image, or None for a scan that cannot be read.
          time: Time of the scan, in seconds.
          odometry: Pose of the LiDAR in any fixed frame.
          compared: Comparisons of an earlier run (`loops.checkpoint`), which are then not repeated.
          continues: See `LoopDetector.add`.

        Raises:
          ValueError: If only some frames have a time or a pose, or if times decrease.
        """
        self._check(keyframe, time, odometry)
        frame = len(self)
        if keyframe is None:
            self.missing.append(frame)
            mounting = self.mountings[-1] if self.mountings else None
            keyframe = Keyframe(np.zeros(self.index.width, np.float32), np.zeros((0, 0), np.uint8), mounting)
        to_upright = upright_from_lidar(keyframe.mounting)
        pose = None if odometry is None else np.asarray(odometry, np.float64) @ inverse(to_upright)
        clock = float(frame) if time is None else time
        middle = np.asarray(within_reach(keyframe.image, self.verification)) if keyframe.image.size else keyframe.image
        empty = np.count_nonzero(keyframe.image) < MIN_CELLS  # too few cells to recognise a place
        if not empty:
            self.stored.check(frame, middle)
        detail, reference = self.background.without(middle), self.motion.keyframe
        spectra = None if empty or compared is not None else query_spectra(detail, config=self.verification)
        query = None if empty else Query(frame, keyframe.descriptor, detail, spectra)
        self.has_odometry = pose is not None
        link = None if compared is None else compared.link
        if not continues:
            self.odometry_check.restart()
        if pose is not None:
            link = self._check_odometry(query, pose, link, known=compared is not None)
        elif compared is None and continues:
            link = self._link(query, clock)
        self.motion.add(clock, pose=pose, link=link, continues=continues)
        self.mountings.append(keyframe.mounting)
        self.motion.path.tilted |= is_tilted(to_upright)
        comparer = KeyframeComparison(self.motion, self.present_drift, self.config, self.verification, self.joined.rows)
        if compared is None:
            compared = (NO_FITS if query is None else comparer.compare(query, self.stored))._replace(link=link)
        candidates = [] if query is None else comparer.candidates(query, compared, self.stored)
        if middle.size and (self.motion.keyframe != reference or not frame):
            self.background.add(middle)
        self._last = None if empty else (frame, detail)
        if self.motion.keyframe == frame:
            self._keyframe = self._last
        if not empty and self.stored.is_new_place(frame, self.motion):
            self.stored.add(frame, keyframe.descriptor, detail)
        self._empty.append(empty)
        if time is not None:
            self._times.append(time)
        self.compared = compared
        return candidates

    @property
    def present_drift(self) -> DriftModel:
        """Drift of the odometry or, without odometry, of the motion estimated from the images."""
        return self.odometry_check.drift(self.drift) if self.has_odometry else MOTION_DRIFT

    @property
    def knows_height(self) -> bool:
        """Whether the odometry measures height. Wheels do not."""
        return self.has_odometry and float(np.ptp(self.motion.path.poses[:, 2, 3])) > FLAT_M

    def close_loop(self, query: int, match: int) -> None:
        """Note an accepted loop between two frames."""
        self.joined.append((query, match))
        self.stored.close_loop(query, match)

    def keyframe(self, scan: Scan) -> Keyframe:
        """Descriptor and 8-bit density image of a scan or image. Nothing is stored."""
        return described(self.params, scan)

    def _link(self, query: Query | None, clock: float) -> BevRegistration | None:
        """Pose of the next frame in the frame of the motion's keyframe, or None if the images do not show it.

        The image is compared with that of the keyframe and, if this is ambiguous, with that of the last frame. Two
        ambiguous poses that agree are trusted, too. If the images show only the position across a direction, the sensor
        is assumed to move on as before.
        """
        found, ridge = list[BevRegistration](), None
        for frame, image in dict(filter(None, (self._keyframe, self._last))).items():
            if query is None:
                break
            prior = self.motion.prior(clock, frame)
            best, expected = self._linked(query, image, prior)
            if self.motion.is_trusted(best, prior):
                return self._from_keyframe(best, frame)
            near = best if expected is None else self._refined(expected, image, query)
            shown = near.correlation >= MIN_EXPECTED * best.correlation
            if self.motion.is_ridge(best) and shown and np.isfinite(prior).all():
                x, y, yaw = prior
                ridge = self._from_keyframe(best._replace(x=x, y=y, yaw=yaw), frame)
            found.append(self._from_keyframe(near, frame))
        if len(found) == 2 and not any(map(self.motion.is_ridge, found)):
            first, second = found
            apart_m, turned = np.hypot(first.x - second.x, first.y - second.y), first.angle_to(float(second.yaw))
            if apart_m <= AGREE_M and turned <= np.radians(AGREE_DEG):
                return first
        return ridge

    def _check_odometry(
        self, query: Query | None, pose: Float[np.ndarray, "4 4"], link: BevRegistration | None, *, known: bool
    ) -> BevRegistration | None:
        """Compare the odometry with the images, if this is due. Returns the pose in the frame of the last such scan."""
        if query is None or not self.odometry_check.is_due(pose):
            self.odometry_check.skip()
            return None
        if not known and self._checked is not None:
            link, _ = self._linked(query, self._checked, np.full(3, np.nan))
        self.odometry_check.add(pose, link)
        self._checked = query.image
        return link

    def _linked(
        self, query: Query, image: UInt8[np.ndarray, "m m"], prior: Float[np.ndarray, " 3"]
    ) -> tuple[BevRegistration, CorrelationPeak | None]:
        """The best pose of a query in the frame of an image, and the best one near an expected pose. None if equal."""
        spectrum = image_spectrum(image, self.verification)
        peaks = jax.device_get(search_near(query.spectra, spectrum, prior, config=self.verification))
        best = self._refined(peaks.at(0), image, query)
        same = bool(np.isnan(prior).any() or peaks.correlation[0] == peaks.correlation[1])
        return best, None if same else peaks.at(1)

    def _refined(self, peak: CorrelationPeak, image: UInt8[np.ndarray, "m m"], query: Query) -> BevRegistration:
        return jax.device_get(refined(query.image, image, peak, config=self.verification))

    def _from_keyframe(self, link: BevRegistration, frame: int) -> BevRegistration:
        """A link with a frame as pose in the frame of the keyframe."""
        key, poses = self.motion.keyframe, self.motion.poses
        if frame == key:
            return link
        moved = inverse(poses[key]) @ poses[frame] @ transform(float(link.x), float(link.y), float(link.yaw))
        return link._replace(x=moved[0, 3], y=moved[1, 3], yaw=yaw_of(moved))

    def _check(self, keyframe: Keyframe | None, time: float | None, odometry: Float[np.ndarray, "4 4"] | None) -> None:
        if not len(self):
            return
        for name, given, known in (
            ("a time", time is not None, self.times is not None),
            ("odometry", odometry is not None, self.has_odometry),
        ):
            if given != known:
                raise ValueError(f"expected {name} for every frame or for none, found both (frame {len(self)})")
        if time is not None and self.times is not None and time < self.times[-1]:
            raise ValueError(f"expected times that do not decrease, found {time} after {self.times[-1]}")
