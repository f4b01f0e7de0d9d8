"""Shortlist of the scans that may show the place of a query, by a coarse comparison of their images.

The coarse comparison has half as many rotations as the search and cells twice as large, so it takes a fifth of the
time. It replaces the descriptors where these do not tell places apart, for instance among trunks.
"""

import dataclasses
from collections.abc import Sequence

import jax
import numpy as np
from jaxtyping import Int, UInt8

from sglpr_jax.loops.config import VerificationConfig
from sglpr_jax.loops.pose_search import search


def coarser(config: VerificationConfig) -> VerificationConfig:
    """Settings of the coarse comparison."""
    blurs = {"blur_m": 2 * config.blur_m, "wide_blur_m": 2 * config.wide_blur_m}
    return dataclasses.replace(config, coarse=2 * config.coarse, turns=config.turns // 2, **blurs)


def shortlist(
    query: UInt8[np.ndarray, "h w"],
    images: Sequence[UInt8[np.ndarray, "n n"]],
    count: int,
    *,
    size: int,
    config: VerificationConfig = VerificationConfig(),
) -> Int[np.ndarray, " k"]:
    """Choose the images with the highest coarse correlation.

    Arguments:
      query: Density image of the query.
      images: Images of the scans, at most `size`.
      count: Number of chosen images.
      size: Number of images of a batch. All batches are padded to it, so that the search compiles once.
      config: Settings of the exact comparison.

    Returns:
      Indices of up to `count` images, the best first.
    """
    if not images:
        return np.zeros(0, np.int64)
    padded = np.stack([images[k] for k in (np.arange(size) % len(images)).tolist()])
    peaks = jax.device_get(search(query, padded, config=coarser(config)))
    return np.argsort(-peaks.correlation[: len(images)], kind="stable")[:count]
