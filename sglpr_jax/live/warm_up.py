"""Compiles the programs of the search before the first scan arrives, so that no scan is dropped meanwhile."""

import dataclasses

import numpy as np

from sglpr_jax.loops.config import DetectorConfig
from sglpr_jax.loops.detector import LoopDetector
from sglpr_jax.models.params import Params

SCANS = 12
"""Number of scans after which everything was used: each is compared with those before it."""


def warm_up(params: Params, config: DetectorConfig, *, odometry: bool) -> None:
    """Search random scans with the sizes of `config`, with odometry or without it, and forget them."""
    anything = {"recent_m": 1e-9, "good_correlation": 2.0, "min_coarse_correlation": -1.0, "min_correlation": -1.0}
    rules = dataclasses.replace(config.candidates, **anything)
    detector = LoopDetector(params, config=dataclasses.replace(config, candidates=rules, max_places=None))
    draw = np.random.default_rng(0)
    for i in range(SCANS):
        points = draw.uniform((-20, -20, -1), (20, 20, 3), (4000, 3)).astype(np.float32)
        pose = np.eye(4)
        pose[0, 3] = 0.01 * i
        detector.add(points, time=0.7 * i, odometry=pose if odometry else None)
