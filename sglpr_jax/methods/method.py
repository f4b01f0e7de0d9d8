"""Interfaces of a method: its input, how it describes the input, and how its descriptors are compared."""

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
    """A method without training. `HANDCRAFTED` in `handcrafted/__init__.py` lists all of them."""

    name: str
    """Name on the command line."""
    source: str
    """Publication of the method."""
    takes: Takes
    describe: Callable[..., Float32[np.ndarray, "..."]]
    """Maps images (n, h, w) to descriptors (n, d), or points (n, 3), and perhaps their classes (n,), to one (d,)."""
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
    """JSON values for descriptor files: the name of the method, by the key `method`, and its configuration."""
    takes: Takes
    prepare: Callable[[Scan, float | None], Any]
    """Returns the input of a scan that is first rotated about z by an angle in radians. Runs in several threads."""
    describe: Callable[[Any], Float[Any, "b d"]]
    """Maps a batch of inputs, stacked along a new first axis, to descriptors."""
    distance: str = "l2"
    """Name of the distance, as `retrieval.distances` reads it. The name of a learned distance includes its weights."""
    weights_hash: str = ""

    @property
    def name(self) -> str:
        """Name on the command line."""
        return self.about["method"]


def check_descriptors(method: str, descriptors: np.ndarray, names: Sequence[str]) -> None:
    """Raise ValueError unless each scan in `names` has a row of `descriptors` that is finite and not only zeros."""
    if descriptors.ndim != 2 or len(descriptors) != len(names):
        raise ValueError(f"{method}: expected {len(names)} descriptors ({len(names)}, d), found {descriptors.shape}")
    is_infinite = ~np.isfinite(descriptors).all(axis=1)
    is_zero = ~descriptors.any(axis=1)
    for is_invalid, found in ((is_infinite, "values that are not finite"), (is_zero, "only zeros")):
        if is_invalid.any():
            first_invalid = names[int(is_invalid.argmax())]
            raise ValueError(f"{method}: expected a descriptor of {first_invalid}, found {found}")
