"""Calibration of loop probabilities on a drive with odometry, without labelled loops.

Negative pairs are farther apart than the odometry can drift. Of these pairs, the ones with the nearest descriptors are
used. Positive pairs are some metres apart in one pass, with one scan rotated. They are easier than revisits, because
nothing has moved between the two scans.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from sglpr_jax.bev import even_cells, rotate_image
from sglpr_jax.data.record import Record
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scan_stream import scan_stream
from sglpr_jax.data.views import picture, rotated
from sglpr_jax.loops.candidates import CandidateFinder
from sglpr_jax.loops.compared_image import occupied
from sglpr_jax.loops.config import CandidateConfig
from sglpr_jax.loops.driven_path import DrivenPath
from sglpr_jax.loops.probability import Evidence, LoopModel, default_model, recalibrated
from sglpr_jax.loops.rivals import distance_share, rival_share
from sglpr_jax.loops.seen import Seen
from sglpr_jax.loops.spectra import query_spectra
from sglpr_jax.loops.stored_scans import image_spectrum
from sglpr_jax.loops.transforms import travelled
from sglpr_jax.loops.verification import refined
from sglpr_jax.models.params import Params
from sglpr_jax.same_place import NEGATIVE_M

NEAR_M = (2.0, 10.0)
"""Minimum and maximum distance of a positive pair, in metres."""
RIVALS = 10
"""Maximum number of rivals of a query."""
SAME_PASS_M = 50.0
"""Maximum travelled distance between the frames of a positive pair, in metres."""


def calibrated(
    params: Params,
    recording: Recording,
    odometry: Float[np.ndarray, "n 4 4"],
    *,
    pairs: int = 200,
    seed: int = 0,
    model: LoopModel | None = None,
    config: CandidateConfig = CandidateConfig(),
    on_progress: Callable[[int], None] = lambda done: None,
) -> LoopModel:
    """Scale and shift the log odds of a loop model to fit a drive with odometry.

    Arguments:
      params: Weights of the model that describes the scans.
      recording: The scans.
      odometry: Pose of the LiDAR at each scan.
      pairs: Number of frames drawn for positive pairs, and number of frames drawn for negative pairs.
      seed: Seed of the random choice.
      model: Model to calibrate, by default the one shipped for the weights.
      config: Settings of the retrieval.
      on_progress: Called with the number of frames done.

    Raises:
      ValueError: If the odometry has another length, if a scan is bad (`scan_stream`), or if the drive has no pairs of
        one kind.
    """
    evidence, is_loop = certain_pairs(
        params, recording, odometry, pairs=pairs, seed=seed, config=config, on_progress=on_progress
    )
    shipped = default_model(CandidateFinder(params).index.weights_hash) if model is None else model
    made_with = f"{shipped.made_with}; {is_loop.sum()} loops and {(~is_loop).sum()} others of {recording.name}"
    return recalibrated(shipped, evidence, is_loop, made_with=made_with)


def certain_pairs(
    params: Params,
    recording: Recording,
    odometry: Float[np.ndarray, "n 4 4"],
    *,
    pairs: int,
    seed: int = 0,
    config: CandidateConfig = CandidateConfig(),
    on_progress: Callable[[int], None] = lambda done: None,
) -> tuple[Evidence, Bool[np.ndarray, " m"]]:
    """Evidence of positive and negative pairs of a drive, and whether each pair is a loop. See `calibrated`."""
    n = len(recording)
    if len(odometry) != n:
        raise ValueError(
            f"expected odometry of {n} poses, one for each scan of {recording.name}, found {len(odometry)}"
        )
    places = _Places(params, recording, odometry, config)
    rng = np.random.default_rng(seed)
    evidence, is_loop = [], []
    for done, frame in enumerate(rng.permutation(n)[: 2 * pairs]):
        turned = places.turned(int(frame), rng.uniform(0, 2 * np.pi))
        near, far = places.near(int(frame)), places.far(int(frame))
        rows = rng.permutation(np.flatnonzero(near))[:1] if done % 2 else places.nearest(turned.descriptor, far)
        for row in rows:
            evidence.append(places.evidence(int(frame), turned, int(row)))
            is_loop.append(bool(near[row]))
        on_progress(done + 1)
    if not evidence or all(is_loop) or not any(is_loop):
        raise ValueError(
            f"{recording.name}: expected frames {NEAR_M[0]:g} to {NEAR_M[1]:g} m apart, and frames farther apart than "
            "the odometry can drift, found no pairs of at least one kind; calibrate on a longer drive"
        )
    return Evidence.stack(evidence), np.array(is_loop)


class _Places:
    """Descriptors, images and odometry of all frames of a drive."""

    def __init__(
        self, params: Params, recording: Recording, odometry: Float[np.ndarray, "n 4 4"], config: CandidateConfig
    ):
        self.finder, self.recording, self.config = CandidateFinder(params, config=config), recording, config
        self.images: list[UInt8[np.ndarray, "n n"]] = []
        for _, seen in scan_stream(recording, lambda row, record: self.finder.seen(record)):
            assert seen is not None  # the stream raises the error of a bad scan
            self.images.append(seen.image)
            self.finder.index.add(seen.descriptor)
        self.positions, self.way, self.path = odometry[:, :3, 3], travelled(odometry), DrivenPath.of(odometry)

    def apart(self, frame: int) -> Float[np.ndarray, " n"]:
        return np.linalg.norm(self.positions - self.positions[frame], axis=1)

    def near(self, frame: int) -> Bool[np.ndarray, " n"]:
        """Frames that make a positive pair with `frame`."""
        apart = self.apart(frame)
        return (apart >= NEAR_M[0]) & (apart <= NEAR_M[1]) & (np.abs(self.way - self.way[frame]) <= SAME_PASS_M)

    def far(self, frame: int) -> Bool[np.ndarray, " n"]:
        """Frames that certainly show another place than `frame`."""
        drift = self.finder.drift
        drifted = self.path.position_deviations(np.arange(len(self.positions)), frame, drift=drift)
        return self.apart(frame) > NEGATIVE_M + drift.max_deviation * drifted

    def nearest(self, descriptor: Float32[np.ndarray, " d"], among: Bool[np.ndarray, " n"]) -> np.ndarray:
        """Return the frame with the nearest descriptor among those flagged in `among`, in an array of at most one."""
        rows = self.finder.index.query(descriptor, exclude=~among).rows
        return rows[rows >= 0]

    def turned(self, frame: int, angle: float) -> Seen:
        """Descriptor and image of a frame rotated by `angle` (radians)."""
        record = self.recording.record(frame, labels=False)
        if record.points is not None:
            return self.finder.seen(Record(points=rotated(record.upright_points, angle)))
        whole = even_cells(jnp.asarray(picture(record, None)[0]))
        return self.finder.seen(Record(image=np.asarray(rotate_image(whole, jnp.float32(angle)))))

    def evidence(self, frame: int, query: Seen, row: int) -> Evidence:
        """Evidence of a pair. Its rivals are the frames with the nearest descriptors that show neither place."""
        finder = self.finder
        elsewhere = self.far(frame) & (self.apart(row) > NEGATIVE_M)
        found = finder.index.query(query.descriptor, RIVALS, exclude=~elsewhere).rows
        rows = [row, *found[found >= 0].tolist()]
        spectra = query_spectra(query.image, config=finder.verification)
        peaks = finder.comparer.search(spectra, [image_spectrum(self.images[k], finder.verification) for k in rows])
        peak = peaks.one(0)
        share = rival_share(peaks.some(slice(1, None)), float(peak.correlation), [])
        fitted = jax.device_get(refined(query.image, self.images[row], peak, config=finder.verification))
        distance = float(np.linalg.norm(finder.index.descriptors[row].astype(np.float64) - query.descriptor))
        apart = np.linalg.norm(finder.index.descriptors[rows[1:]] - query.descriptor, axis=1)
        nearest = distance_share(distance, apart, [])
        cells = min(occupied(image, finder.verification) for image in (query.image, self.images[row]))
        return Evidence.of(distance, nearest, fitted.correlation, fitted.second, share, cells)
