"""Reliability of loop probabilities (share of loops in bins of probability), and calibration on a drive."""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, UInt8

from sglpr_jax.bev import even_cells, rotate_image
from sglpr_jax.data.poses import as_scan_poses
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scan import Scan
from sglpr_jax.data.scan_stream import scan_stream
from sglpr_jax.data.views import picture, rotated
from sglpr_jax.loops.candidates import CandidateSearch
from sglpr_jax.loops.comparison import Candidate, KeyframeComparison, Query
from sglpr_jax.loops.keyframes import Keyframe, StoredScans
from sglpr_jax.loops.probability import Evidence, LoopModel, default_model, recalibrated
from sglpr_jax.models.weights import Params
from sglpr_jax.odometry.bev_odometry import BevOdometry
from sglpr_jax.odometry.drift_model import DriftModel
from sglpr_jax.odometry.path import level_odometry
from sglpr_jax.registration.bev_spectra import within_reach
from sglpr_jax.same_place import NEGATIVE_M

EDGES = (0.0, 0.01, 0.1, 0.3, 0.5, 0.7, 0.9, 0.99, 1.0)
"""Edges of the bins of probability. Bins near 0 and 1 are narrow, because loops are accepted and rejected there."""
LOOP_M = 10.0
"""Maximum distance of the two scans of a loop, in metres."""
NEAR_M = (2.0, 10.0)
"""Minimum and maximum distance of the two scans of a positive pair for calibration, in metres."""
SAME_PASS_M = 50.0
"""Maximum travelled distance between the two frames of these pairs, in metres."""


class Bin(NamedTuple):
    """Bin of pairs with similar probability."""

    low: float
    high: float
    """Range of the probabilities. The last bin includes 1."""
    pairs: int
    """Number of pairs."""
    loops: int
    """Number of pairs that are loops."""
    probability: float
    """Mean probability of the pairs."""

    @property
    def share(self) -> float:
        """Share of loops among the pairs of the bin."""
        return self.loops / self.pairs


def reliability(probability: Float[np.ndarray, " n"], is_loop: Bool[np.ndarray, " n"]) -> tuple[Bin, ...]:
    """Sort pairs into the bins of `EDGES`. Returns the bins that have pairs, in order of probability."""
    bins = []
    for low, high in itertools.pairwise(EDGES):
        inside = (probability >= low) & ((probability < high) | (high == EDGES[-1]))
        if inside.any():
            mean = float(probability[inside].mean().clip(low, high))  # rounding may move the mean out of the bin
            bins.append(Bin(low, high, int(inside.sum()), int(is_loop[inside].sum()), mean))
    return tuple(bins)


def calibration_error(bins: Sequence[Bin]) -> float:
    """Expected calibration error: mean difference between probability and share of loops, weighted by pairs."""
    pair_counts = np.array([each.pairs for each in bins])
    return float(pair_counts @ [abs(each.probability - each.share) for each in bins] / pair_counts.sum())


def reliability_of(
    candidates: Sequence[Candidate], model: LoopModel, positions: Float[np.ndarray, "n 3"]
) -> tuple[Bin, ...]:
    """Reliability of candidates, given the true position of each frame in metres.

    Scans up to `LOOP_M` apart are loops, and scans more than `NEGATIVE_M` apart are not. Pairs between are left out.
    """
    evidence, is_loop = [], []
    for pair in candidates:
        apart_m = np.linalg.norm(positions[pair.query] - positions[pair.match])
        if apart_m <= LOOP_M or apart_m > NEGATIVE_M:
            evidence.append(pair.evidence)
            is_loop.append(apart_m <= LOOP_M)
    return reliability(model.probability(Evidence.stack(evidence)), np.array(is_loop, bool))


def calibrated(
    params: Params, recording: Recording, odometry: Float[np.ndarray, "n 4 4"], *, pairs: int = 200, seed: int = 0
) -> LoopModel:
    """Scale and shift the log odds of the shipped loop model to fit a drive with odometry.

    Arguments:
      params: Weights of the model that describes the scans.
      recording: The scans.
      odometry: Pose of the LiDAR at each scan.
      pairs: Number of frames drawn for positive pairs (near scans), and number drawn for negative pairs (far scans).
      seed: Seed of the random choice.

    Raises:
      ValueError: If the odometry has another length, if a scan cannot be read or shows no place, or if no positive or
        no negative pair is found.
    """
    evidence, is_loop = certain_pairs(params, recording, odometry, pairs=pairs, seed=seed)
    shipped = default_model()
    made_with = f"{shipped.made_with}; {is_loop.sum()} loops and {(~is_loop).sum()} others of {recording.name}"
    return recalibrated(shipped, evidence, is_loop, made_with=made_with)


def certain_pairs(
    params: Params, recording: Recording, odometry: Float[np.ndarray, "n 4 4"], *, pairs: int, seed: int = 0
) -> tuple[Evidence, Bool[np.ndarray, " m"]]:
    """Evidence of positive and negative pairs of a drive, and whether each is a loop. Arguments as in `calibrated`."""
    n = len(recording)
    drive = _Drive(params, recording, as_scan_poses(odometry, recording, of="odometry"))
    rng = np.random.default_rng(seed)
    evidence, is_loop = [], []
    for draw, frame in enumerate(rng.permutation(n)[: 2 * pairs].tolist()):
        positive = bool(draw % 2)  # in turn
        pair = drive.pair(frame, rng.uniform(0, 2 * np.pi), positive=positive)
        if pair is not None:
            evidence.append(pair.evidence)
            is_loop.append(positive)
    if not evidence or all(is_loop) or not any(is_loop):
        raise ValueError(
            f"{recording.name}: expected frames {NEAR_M[0]:g} to {NEAR_M[1]:g} m apart, and frames farther apart than "
            "the odometry can drift, found no pairs of at least one kind; calibrate on a longer drive"
        )
    return Evidence.stack(evidence), np.array(is_loop)


class _Drive:
    """Stored scans of a drive, and its odometry.

    The motion has one frame more than the drive: a frame of unknown pose, which all queries use. The motion then says
    nothing about their matches, as after a long drive.
    """

    def __init__(self, params: Params, recording: Recording, odometry: Float[np.ndarray, "n 4 4"]):
        self.finder, self.recording = CandidateSearch(params), recording
        self.motion = BevOdometry.of(level_odometry(odometry, recording.uprights))
        self.motion.add(0.0, continues=False)  # the frame of the queries
        self.stored = StoredScans(self.finder.index)
        for row, keyframe in scan_stream(recording, lambda row, scan: self.finder.keyframe(scan)):
            assert keyframe is not None  # the stream raises the error of a bad scan
            self.stored.add(row, keyframe.descriptor, self._foreground(keyframe))
        self.comparer = KeyframeComparison(self.motion, DriftModel())

    def pair(self, frame: int, angle: float, *, positive: bool) -> Candidate | None:
        """Best candidate of a frame, rotated by `angle` (radians), or None: a near scan if `positive`, or a far one.

        The search for it may use near (or far) scans as matches, and far scans as distractors.
        """
        poses, frames = self.motion.poses, self.stored.frames
        apart_m = np.linalg.norm(poses[frames, :3, 3] - poses[frame, :3, 3], axis=1)
        far = (apart_m > NEGATIVE_M) & self.comparer.are_elsewhere(frames, frame)
        near = (apart_m >= NEAR_M[0]) & (apart_m <= NEAR_M[1])
        near &= self.comparer.travelled_between(frames, frame) <= SAME_PASS_M
        possible = near if positive else far
        query = self.rotated_query(frame, angle)
        scans = self.stored.view(searchable=far | possible)
        fits = self.comparer.compare(query, scans, possible=possible)
        candidates = self.comparer.candidates(query, fits, scans, possible=np.isin(fits.frames, frames[possible]))
        return candidates[0] if candidates else None

    def rotated_query(self, frame: int, angle: float) -> Query:
        """Describe the scan of a frame after a rotation by `angle` (radians), as a query of unknown pose."""
        scan = self.recording.scan(frame, labels=False)
        if scan.points is not None:
            rotated_scan = Scan(points=rotated(scan.upright_points, angle))
        else:
            even_image = even_cells(jnp.asarray(picture(scan, None)[0]))
            rotated_scan = Scan(image=np.asarray(rotate_image(even_image, jnp.float32(angle))))
        keyframe = self.finder.keyframe(rotated_scan)
        return Query(len(self.motion) - 1, keyframe.descriptor, self._foreground(keyframe))

    def _foreground(self, keyframe: Keyframe) -> UInt8[np.ndarray, "m m"]:
        """Central part of an image without the rings of the background, as in a search."""
        return self.finder.background.without(np.asarray(within_reach(keyframe.image)))
