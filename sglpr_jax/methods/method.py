"""Interface of a method: how it describes scans or images, its inputs, and how its descriptors are compared."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32, Shaped

from sglpr_jax.data.recording import Record, Recording
from sglpr_jax.grid import Grid, ImageKind

Takes = Literal["images", "points", "labelled points"]
"""Input of a method."""
DescribeFn = Callable[..., Float[Any, "b d"]]
"""Maps images of point counts (b, h, w), and maps of classes (b, h, w) if requested, to one descriptor each."""
DescribeScanFn = Callable[[Float32[np.ndarray, "n 3"], Int32[np.ndarray, " n"] | None], Float32[np.ndarray, " d"]]
"""Maps the points of one scan, and their classes if requested, to its descriptor."""
DistanceFn = Callable[[Float32[np.ndarray, "q d"], Float32[np.ndarray, "n d"]], Float32[np.ndarray, "q n"]]
"""Maps the descriptors of queries and of a database to distances. Smaller distances mean more similar places."""


@dataclass(frozen=True)
class HandcraftedMethod:
    """A method without training, as declared by its file in `handcrafted/`."""

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
class ImageMethod:
    """A method that describes images: the function, its window (None: whole images), and a description of the
    method."""

    describe: DescribeFn
    grid: Grid | None
    about: dict[str, Any]
    """Name of the method and its configuration, as JSON values."""
    weights_hash: str = ""
    categories: int = 0
    """Number of categories of the class maps that the function also needs. 0: no class maps."""
    image: ImageKind = "points"
    """Kind of image that is made of raw scans."""
    field: Bool[np.ndarray, "h w"] | None = None
    """Cells that the function uses. None: all cells."""


@dataclass(frozen=True)
class ScanMethod:
    """A method that describes the points of a scan: the function, whether it needs labels, and its distance."""

    describe: DescribeScanFn
    labels: bool
    distance: str
    """Name of a distance in `retrieval.distances`."""
    about: dict[str, Any]
    """Description of the method, as JSON values."""
    weights_hash: str = ""


@dataclass(frozen=True)
class RecordMethod:
    """A learned method of another publication: it prepares the input of each record and describes inputs in batches."""

    prepare: Callable[[Record], Shaped[np.ndarray, "..."]]
    describe: Callable[[Shaped[np.ndarray, "b ..."]], Float[Any, "b d"]]
    takes: Takes
    """Content that `prepare` needs. Methods that take images accept ready-made images and scans."""
    distance: str
    """Name of a distance in `retrieval.distances`. A learned distance also names its weights."""
    about: dict[str, Any]
    """Description of the method, as JSON values."""
    weights_hash: str


Method = ImageMethod | ScanMethod | RecordMethod
"""A method that `retrieval.embed` accepts."""


def require_content(name: str, takes: Takes, recording: Recording, *, every_label: bool = False) -> None:
    """Raise ValueError, in one line, if a recording lacks the points or labels of the method called `name`.

    Arguments:
      name: Name of the method.
      takes: Input of the method. Methods on images also accept scans.
      recording: Recording to check.
      every_label: Whether every scan must have labels. Otherwise one label file suffices.
    """
    if takes == "images":
        return
    if recording.has_images:
        raise ValueError(f"{name} needs points, found only images in sequence {recording.name}")
    if takes != "labelled points":
        return
    if not recording.has_labels:
        raise ValueError(f"{name} needs labels beside the scans, found none in sequence {recording.name}")
    missing = [name for name, labelled in zip(recording.ids, recording.labelled, strict=True) if not labelled]
    if every_label and missing:
        raise ValueError(
            f"{name} needs labels of every scan, found none for {len(missing)} scans of sequence {recording.name}, "
            f"the first is {missing[0]}"
        )
