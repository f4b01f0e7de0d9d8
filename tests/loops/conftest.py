"""A simulated street that is driven twice, what a detector finds in it, and pairs without a comparison of images."""

from collections.abc import Callable, Mapping

import numpy as np
import pytest
from drives import drive, params, revisit, street  # noqa: F401

from sglpr_jax.loops.comparison import Candidate, KeyframeComparison
from sglpr_jax.loops.detector import LoopDetector
from sglpr_jax.loops.keyframes import Keyframe, describe_scan
from sglpr_jax.loops.probability import Evidence
from sglpr_jax.registration.bev_alignment import BevRegistration
from sglpr_jax.se3 import yaw_of


@pytest.fixture(scope="session")
def described(street, params) -> list[Keyframe]:  # noqa: F811
    """Description of each scan of the street."""
    return [describe_scan(params, street.scan(i, labels=False)) for i in range(len(street))]


@pytest.fixture(scope="session")
def streamed(street, described, params):  # noqa: F811
    """The detector after the whole street, with odometry, and what it returned frame by frame."""
    detector = LoopDetector(params)
    frames = zip(described, street.times.tolist(), street.poses.world_from_lidar, strict=True)
    return detector, [detector.add_keyframe(keyframe, time=time, odometry=pose) for keyframe, time, pose in frames]


@pytest.fixture
def compare_only(monkeypatch) -> Callable[[Mapping[int, tuple[int, np.ndarray]]], None]:
    """`compare_only({query: (match, match_from_query)})` replaces the comparison of images: each query has this match,
    with clear images, and with the deviation of this pose from the motion."""

    def only(pairs: Mapping[int, tuple[int, np.ndarray]]) -> None:
        def candidates(self, query, fits, *_, **__) -> list[Candidate]:
            if query.frame not in pairs:
                return []
            match, pose = pairs[query.frame]
            planar = np.array([[*pose[:2, 3], yaw_of(pose)]])
            (deviation,) = self.deviations(query.frame, np.array([match]), planar)
            alignment = BevRegistration(*planar[0], np.diag([0.05, 0.05, 0.005]) ** 2, 0.8, 0.3)
            return [Candidate(query.frame, match, alignment, Evidence.of(0.3, 0.1, deviation, 3.0))]

        monkeypatch.setattr(KeyframeComparison, "candidates", candidates)

    return only
