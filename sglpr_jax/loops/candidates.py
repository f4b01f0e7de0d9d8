"""Candidate matches of the scans of a stream: each scan is described, compared with earlier scans, and stored."""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, UInt8

from sglpr_jax.data.mounting import Mounting
from sglpr_jax.data.record import Record
from sglpr_jax.growing import GrowingArray
from sglpr_jax.loops.background import Background
from sglpr_jax.loops.compared_image import within_reach
from sglpr_jax.loops.comparison import Candidate, Comparer
from sglpr_jax.loops.config import CandidateConfig, DriftModel, VerificationConfig
from sglpr_jax.loops.given import check_is
from sglpr_jax.loops.motion import Motion
from sglpr_jax.loops.mountings import Mountings, upright_from_lidar
from sglpr_jax.loops.pose_search import Peak, search_near
from sglpr_jax.loops.seen import Seen, described
from sglpr_jax.loops.spectra import query_spectra
from sglpr_jax.loops.stored_scans import StoredScans, image_spectrum
from sglpr_jax.loops.transforms import inverse
from sglpr_jax.models.params import Params
from sglpr_jax.models.weights import weights_hash
from sglpr_jax.retrieval.index import Index
from sglpr_jax.revisits import are_recent


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
        self.stored = StoredScans(index, verification=verification, keyframe_m=keyframe_m, max_places=max_places)
        """Descriptors, and centres of the images without the background, for comparison."""
        self.compared = Compared([], None)
        """Comparisons of the last frame."""
        self.has_odometry = False
        """Whether the frames have poses from odometry. If so, `motion` holds them."""
        self.mountings = Mountings()
        """Mounting of the sensor at each frame."""
        self._empty = GrowingArray(np.empty(0, bool))
        self.motion = Motion(config.motion)
        self.comparer = Comparer(self.stored, self.motion, config, verification, drift)
        self.background = Background(frames=config.background_frames, least=config.min_background_frames)
        self.missing: list[int] = []
        """Frames whose scans cannot be read."""
        self._times = GrowingArray(np.empty(0))
        self._keyframe = np.zeros((0, 0), np.complex64)
        """Spectrum of the image of the motion's keyframe, as in `stored`."""

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
        arrays = self.stored, self.motion, self._times, self._empty, self.mountings
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
        continues: bool = True,
    ) -> list[Candidate]:
        """Add a frame that is already described, and return its candidate. Raises the errors of `add`.

        Arguments:
          seen: Descriptor and image, or None for a scan that cannot be read.
          time: Time of the scan, in seconds.
          odometry: Pose of the LiDAR in any fixed frame.
          compared: Comparisons of an earlier run. If they are given, they are not repeated.
          continues: See `LoopDetector.add`.
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
            compared = self._compared(seen._replace(image=detail), time, upright, clock, continues=continues)
        else:
            self.motion.add(clock, pose=upright, link=compared.link, continues=continues)
        if middle.size and (self.motion.keyframe != keyframe or not frame):
            self.background.add(middle)
        if self.motion.keyframe == frame:
            self._keyframe = image_spectrum(detail, self.verification) if not empty else self._keyframe[:0]
        self._keep(frame, seen, detail, time, empty)
        self.has_odometry = pose is not None
        self.compared = compared
        return compared.candidates

    def _keep(
        self,
        frame: int,
        seen: Seen,
        detail: UInt8[np.ndarray, "m m"],
        time: float | None,
        empty: bool,
    ) -> None:
        """Store what later frames need of a frame."""
        if not empty and self.stored.is_new_place(frame, self.motion):
            self.stored.add(frame, seen.descriptor, detail)
        self._empty.append(empty)
        self.mountings.append(seen.mounting)
        if time is not None:
            self._times.append(time)

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
        pose: Float[np.ndarray, "4 4"] | None,
        clock: float,
        *,
        continues: bool,
    ) -> Compared:
        """Compare the next frame with its nearest frames and the keyframe, and add it to the motion."""
        if self.is_empty(seen.image):
            self.motion.add(clock, pose=pose, continues=continues)
            return Compared([], None)
        excluded = self._excluded(time, pose, continues=continues)
        spectra = query_spectra(seen.image, config=self.verification)
        link = self._link(spectra, clock) if pose is None and continues else None
        self.motion.add(clock, pose=pose, link=link, continues=continues)
        fit = self.comparer.fit if pose is None else self.comparer.fit_on_floor
        rows, found = self.comparer.compared(seen.descriptor, spectra, excluded, fit=fit)
        if not len(rows):
            return Compared([], link)
        best = int(np.argmax(fit(rows, found)))
        if found.correlation[best] < self.config.min_correlation:
            return Compared([], link)
        return Compared([self.comparer.candidate(len(self), seen, spectra, rows, found, best)], link)

    def _link(self, spectra: Complex[Array, "2 s t f"], clock: float) -> Peak | None:
        """Pose of the next frame in the frame of the motion's keyframe. None if there is no image to compare with."""
        if not len(self) or self.empty[self.motion.keyframe]:
            return None
        prior = self.motion.prior(clock)
        peaks = jax.device_get(search_near(spectra, self._keyframe, prior, config=self.verification))
        return self.motion.link(peaks.one(0), peaks.one(1))

    def _check(self, seen: Seen | None, time: float | None, odometry: Float[np.ndarray, "4 4"] | None) -> None:
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

    def _excluded(
        self, time: float | None, pose: Float[np.ndarray, "4 4"] | None, *, continues: bool
    ) -> Bool[np.ndarray, " n"]:
        """Stored scans that cannot match the next frame: too recent, or too far away by odometry."""
        config, frames = self.config, self.stored.frames
        seconds, count = config.exclude_s, config.exclude_frames
        recent = are_recent(len(self), self.times, time, seconds=seconds, frames=count, rows=frames)
        if not continues:
            return recent
        excluded = recent | self.motion.near_last(config.min_travelled_m, frames)
        if pose is not None and len(frames):
            path, position = self.motion.path, pose[:3, 3]
            drifted = path.position_deviations(frames, len(path) - 1, position, drift=self.drift)
            apart = np.linalg.norm(path.poses[frames, :3, 3] - position, axis=1)
            place_m = np.sqrt(2) * self.verification.max_shift_m  # largest shift along x and y
            far = apart > place_m + self.drift.max_deviation * drifted
            excluded = excluded | (far & self.motion.same(-1, frames))
        return excluded
