"""Interface of a method: how it describes scans or images, its inputs, and how its descriptors are compared."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Float32

from sglpr_jax.data.scan import Scan

Takes = Literal["images", "points", "labelled points", "labelled images"]
"""Content of a scan that a method needs. Methods on images accept ready-made images and point clouds."""
LABELLED: tuple[Takes, ...] = ("labelled points", "labelled images")
DistanceFn = Callable[[Float32[np.ndarray, "q d"], Float32[np.ndarray, "n d"]], Float32[np.ndarray, "q n"]]
"""Maps the descriptors of queries and of a database to distances. Smaller distances mean more similar places."""


@dataclass(frozen=True)
class HandcraftedMethod:
    """A method without training, an entry of the table in `handcrafted/`."""

    name: str
    """Name on the command line."""
    source: str
    """Publication of the method."""
    takes: Takes
    """Input: images (n, h, w), described as (n, d), or the points (n, 3) of one scan, described as (d,). Labelled
    points have classes (n,)."""
    describe: Callable[..., Float32[np.ndarray, "..."]]
    distance: DistanceFn | None = None
    """Distance between descriptors. None: L2."""
    describe_ready_made: Callable[..., Float32[np.ndarray, "n d"]] | None = None
    """Replaces `describe` for ready-made images, which may be empty near their borders."""

    @property
    def distance_name(self) -> str:
        """Name of the distance in a descriptor file: "l2", or the name of the method."""
        return "l2" if self.distance is None else self.name


@dataclass(frozen=True)
class Method:
    """A method as `retrieval.embed` runs it: it prepares the input of each scan and describes inputs in batches."""

    about: dict[str, Any]
    """Name of the method (`method`) and its configuration, as JSON values."""
    takes: Takes
    prepare: Callable[[Scan, float | None], Any]
    """Returns the input of a scan that is first rotated about z by an angle in radians (None: not rotated). Called in
    several threads."""
    describe: Callable[[Any], Float[Any, "b d"]]
    """Maps a batch of inputs, stacked along a new first axis, to descriptors."""
    distance: str = "l2"
    """Name of a distance in `retrieval.distances`. A learned distance also names its weights."""
    weights_hash: str = ""

    @property
    def name(self) -> str:
        """Name on the command line."""
        return self.about["method"]


def check_descriptors(method: str, descriptors: np.ndarray, names: Sequence[str]) -> None:
    """Raise ValueError unless each of the scans called `names` has a descriptor (d,) that is finite and not zero."""
    if descriptors.ndim != 2 or len(descriptors) != len(names):
        raise ValueError(f"{method}: expected {len(names)} descriptors ({len(names)}, d), found {descriptors.shape}")
    infinite, empty = ~np.isfinite(descriptors).all(axis=1), ~descriptors.any(axis=1)
    for is_bad, found in ((infinite, "values that are not finite"), (empty, "only zeros")):
        if is_bad.any():
            raise ValueError(f"{method}: expected a descriptor of {names[int(is_bad.argmax())]}, found {found}")
