"""What a method is made of: how it describes scans or images, what it needs for that, how its descriptors compare."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32

from sglpr_jax.grid import Grid, ImageKind

DescribeFn = Callable[..., Float[Any, "b d"]]
"""Images of point counts (b, h, w) and, where asked for, maps of classes (b, h, w) in; one descriptor each out."""
DescribeScanFn = Callable[[Float32[np.ndarray, "n 3"], Int32[np.ndarray, " n"] | None], Float32[np.ndarray, " d"]]
"""The points of one scan and, where asked for, their classes in; its descriptor out."""
DistanceFn = Callable[[Float32[np.ndarray, "q d"], Float32[np.ndarray, "n d"]], Float32[np.ndarray, "q n"]]
"""The descriptors of queries and of a database in; their distances out, smaller for places more alike."""


@dataclass(frozen=True)
class HandcraftedMethod:
    """A method that needs no training, as its file in `handcrafted/` declares it."""

    name: str
    """As a command line takes it."""
    source: str
    """The publication."""
    takes: Literal["images", "points", "labelled points"]
    """Images (n, h, w) -> (n, d); the points of one scan (n, 3) -> (d,); or points and classes (n,) -> (d,)."""
    describe: Callable[..., Float32[np.ndarray, "..."]]
    distance: DistanceFn | None = None
    """How its descriptors are compared; None: by L2."""
    describe_ready_made: Callable[..., Float32[np.ndarray, "n d"]] | None = None
    """What describes ready-made images where it is not `describe`: they may be empty near their borders."""

    @property
    def distance_name(self) -> str:
        """What a descriptor file calls the distance: L2, or by the method's own name."""
        return "l2" if self.distance is None else self.name


@dataclass(frozen=True)
class ImageMethod:
    """A way to describe images: the function, the window it wants (None: images whole), and what to write about it."""

    describe: DescribeFn
    grid: Grid | None
    about: dict[str, Any]
    """The method and its configuration, as JSON can hold them."""
    weights_hash: str = ""
    categories: int = 0
    """The function wants maps of so many classes too; 0: of none."""
    image: ImageKind = "points"
    """What raw scans are made into."""
    field: Bool[np.ndarray, "h w"] | None = None
    """In which cells the function looks; None: in all."""


@dataclass(frozen=True)
class ScanMethod:
    """A way to describe the points of a scan: the function, whether it wants labels, and how to compare the results."""

    describe: DescribeScanFn
    labels: bool
    distance: str
    """The name of one in `retrieval.distances`."""
    about: dict[str, Any]
    """The method, as JSON can hold it."""
    weights_hash: str = ""


Method = ImageMethod | ScanMethod
"""Anything that `retrieval.embed` describes a recording by."""
