"""Search of scaled recordings: what the search is given is multiplied by the scale, and its results are divided by it.

In between, all lengths are those of the scaled scans. Thresholds in metres, except those of `scaled_config`, are then
relative to the images: with a scale of 4, 12 m between two scans of one place are 3 m.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.choices import Scale
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scaled import scaled, scaled_poses
from sglpr_jax.loops.config import DetectorConfig, DriftModel
from sglpr_jax.loops.loop import Loop, Rejected


class Search(NamedTuple):
    """Input of a search: a recording, the pose of the LiDAR at each of its scans, and the settings."""

    recording: Recording
    odometry: Float[np.ndarray, "n 4 4"] | None
    config: DetectorConfig

    def scaled(self, scale: Scale) -> "Search":
        """The same input with all lengths multiplied by `scale`."""
        odometry = None if self.odometry is None else scaled_poses(self.odometry, float(scale))
        return Search(scaled(self.recording, scale), odometry, scaled_config(self.config, scale))


def scaled_config(config: DetectorConfig, scale: Scale) -> DetectorConfig:
    """Settings for scaled scans. Settings that do not belong to the images are in real metres, and are scaled."""
    return dataclasses.replace(
        config,
        keyframe_m=config.keyframe_m * scale,
        drift=scaled_drift(config.drift, float(scale)),
    )


def scaled_drift(drift: DriftModel, factor: float) -> DriftModel:
    """Drift of odometry whose translations were multiplied by `factor`. Shares of the distance do not change."""
    return dataclasses.replace(drift, degrees_per_metre=drift.degrees_per_metre / factor)


def divided_loop(loop: Loop, scale: Scale) -> Loop:
    """Loop of scans before they were multiplied by `scale`."""
    return dataclasses.replace(
        loop,
        match_from_query=scaled_poses(loop.match_from_query, 1 / scale),
        covariance=divided_covariance(loop.covariance, scale),
    )


def divided_rejected(rejected: Rejected, scale: Scale) -> Rejected:
    """Rejected pair of scans before they were multiplied by `scale`."""
    return dataclasses.replace(rejected, loop=divided_loop(rejected.loop, scale))


def divided_covariance(covariance: Float[np.ndarray, "6 6"], scale: Scale) -> Float[np.ndarray, "6 6"]:
    """Covariance of a pose (x, y, z, rotations) before its lengths were multiplied by `scale`."""
    units = np.repeat([1 / scale, 1.0], 3)
    return covariance * np.outer(units, units)
