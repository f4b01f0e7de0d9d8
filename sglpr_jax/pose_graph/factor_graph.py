"""Factor graph of gtsam (extra `gtsam`) with the noise of odometry and loops."""

from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Float

from sglpr_jax.extras import optional_module

FIRST_POSE = 1e-6
"""Standard deviation of the first pose, which stays fixed, in metres and radians."""


def gtsam_library() -> ModuleType:
    """Import gtsam. Raises ImportError if the extra `gtsam` is not installed."""
    return optional_module("gtsam", "optimisation of a trajectory", extra="gtsam")


class FactorGraph:
    """Graph of nodes with unknown poses: factors (measured poses between nodes), and first estimates of the poses."""

    def __init__(self):
        self._gtsam = gtsam_library()
        self.factors, self.estimates = self._gtsam.NonlinearFactorGraph(), self._gtsam.Values()

    def add_node(self, node: int, pose: Float[np.ndarray, "4 4"], *, fixed: bool = False) -> None:
        """Add a node with an estimate of its pose, which does not change if it is `fixed`."""
        self.estimates.insert(node, self._gtsam.Pose3(pose))
        if fixed:
            noise = self._gtsam.noiseModel.Isotropic.Sigma(6, FIRST_POSE)
            self.factors.add(self._gtsam.PriorFactorPose3(node, self._gtsam.Pose3(pose), noise))

    def add_step(
        self, before: int, after: int, step: Float[np.ndarray, "4 4"], *, metres: float, radians: float
    ) -> None:
        """Connect two nodes by odometry: pose of the later in the earlier node, and standard deviations by axis."""
        self._connect(before, after, step, self._gtsam.noiseModel.Diagonal.Sigmas(np.repeat([radians, metres], 3)))

    def add_loop(
        self,
        match: int,
        query: int,
        match_from_query: Float[np.ndarray, "4 4"],
        covariance: Float[np.ndarray, "6 6"],
        *,
        cauchy: float | None = None,
    ) -> None:
        """Connect two nodes by a loop. `cauchy` makes its cost robust: at this residual, in standard deviations, a
        loop has half its weight."""
        noise = self._gtsam.noiseModel.Gaussian.Covariance(rotation_first(covariance))
        if cauchy is not None:
            robust = self._gtsam.noiseModel.mEstimator.Cauchy(cauchy)
            noise = self._gtsam.noiseModel.Robust.Create(robust, noise)
        self._connect(match, query, match_from_query, noise)

    def _connect(self, first: int, second: int, pose: Float[np.ndarray, "4 4"], noise: Any) -> None:
        self.factors.add(self._gtsam.BetweenFactorPose3(first, second, self._gtsam.Pose3(pose), noise))


def rotation_first(covariance: Float[np.ndarray, "6 6"]) -> Float[np.ndarray, "6 6"]:
    """Return a covariance of x, y, z and then rotations with rotations first, the order of gtsam."""
    order = np.array([3, 4, 5, 0, 1, 2])
    return covariance[np.ix_(order, order)]
