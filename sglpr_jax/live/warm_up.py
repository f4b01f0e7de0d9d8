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
    rules = config.candidates
    rivals = dataclasses.replace(rules.rivals, age=(0.0, 1e9))
    anywhere = {"exclude_s": 1e-9, "exclude_frames": 0, "min_travelled_m": 0.0, "good_correlation": 2.0}
    anything = {"min_coarse_correlation": -1.0, "min_correlation": -1.0, "rivals": rivals}
    rules = dataclasses.replace(rules, **anywhere, **anything)
    detector = LoopDetector(params, config=dataclasses.replace(config, candidates=rules, max_places=None))
    draw = np.random.default_rng(0)
    for i in range(SCANS):
        points = draw.uniform((-20, -20, -1), (20, 20, 3), (4000, 3)).astype(np.float32)
        detector.add(points, time=0.7 * i, odometry=np.eye(4) if odometry else None)
