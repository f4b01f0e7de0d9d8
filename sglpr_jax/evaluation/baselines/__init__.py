"""Methods without training, to compare with: each a pure function from images or from the points of a scan.

`BASELINES` has them by the name a command line takes. How their descriptors are compared: `evaluation.distances`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from sglpr_jax.evaluation.baselines.lidar_iris import lidar_iris as lidar_iris
from sglpr_jax.evaluation.baselines.m2dp import m2dp as m2dp
from sglpr_jax.evaluation.baselines.polar_fft import polar_fft as polar_fft
from sglpr_jax.evaluation.baselines.random_vector import random_vector as random_vector
from sglpr_jax.evaluation.baselines.scan_context import scan_context as scan_context
from sglpr_jax.evaluation.baselines.solid import solid as solid
from sglpr_jax.evaluation.baselines.ssc import ssc as ssc
from sglpr_jax.evaluation.baselines.thumbnail import thumbnail as thumbnail


@dataclass(frozen=True)
class Baseline:
    """A method: the function, what it takes, and the name of the distance that compares its descriptors."""

    describe: Callable
    input: Literal["images", "points", "labelled points"]
    """Images (n, h, w) -> (n, d); the points of one scan (n, 3) -> (d,); or points and classes (n,) -> (d,)."""
    distance: str = "l2"


BASELINES: dict[str, Baseline] = {
    "scan-context": Baseline(scan_context, "points", distance="scan-context"),
    "m2dp": Baseline(m2dp, "points"),
    "lidar-iris": Baseline(lidar_iris, "points", distance="lidar-iris"),
    "ssc": Baseline(ssc, "labelled points", distance="ssc"),
    "solid": Baseline(solid, "points"),
    "polar-fft": Baseline(polar_fft, "images"),
    "thumbnail": Baseline(thumbnail, "images"),
    "random": Baseline(random_vector, "images"),
}
