"""The methods a descriptor can come from: the network, and references without training, on images or on points."""

import dataclasses
import functools
from typing import Any, Literal

import numpy as np

from sglpr_jax.bev import Grid, ImageKind
from sglpr_jax.data import Drive, ImageSequence
from sglpr_jax.evaluation.baselines import BASELINES, Baseline
from sglpr_jax.models.params import load, weights_hash
from sglpr_jax.models.presets import model_preset
from sglpr_jax.models.sglpr import Params, describe
from sglpr_jax.retrieval.descriptor_file import DescriptorFile
from sglpr_jax.retrieval.embed import DescribeFn, DescribeScanFn, embed, embed_scans

MethodName = Literal["sglpr", "scan-context", "m2dp", "lidar-iris", "ssc", "solid", "polar-fft", "thumbnail", "random"]
BEV_IMAGE_RADIUS = 62.0
"""Pixels from the centre to which the ready-made KITTI images have content."""


@dataclasses.dataclass(frozen=True)
class ImageMethod:
    """A way to describe images: the function, the window it wants (None: images whole), and what to write about it.

    With `categories` the function wants maps of so many classes too. `image` says what raw scans are made into.
    """

    describe: DescribeFn
    grid: Grid | None
    about: dict[str, Any]
    weights_hash: str = ""
    categories: int = 0
    image: ImageKind = "points"

    def embed(self, sequence: Drive, **options: Any) -> DescriptorFile:
        """Describe a whole sequence; options are those of `retrieval.embed.embed`.

        Raises ValueError where the sequence has not the labels that the method needs.
        """
        if self.categories and not sequence.has_labels:
            raise ValueError(
                f"this model describes a place from its labels too (model.head.input): expected labels beside the "
                f"scans, found none in sequence {sequence.name}"
            )
        options |= {"config": {"data": sequence.name, **self.about}, "weights_hash": self.weights_hash}
        options |= {"categories": self.categories, "image": self.image}
        return embed(self.describe, sequence, self.grid, **options)


@dataclasses.dataclass(frozen=True)
class ScanMethod:
    """A way to describe the points of a scan: the function, whether it wants labels, and how to compare the results."""

    describe: DescribeScanFn
    labels: bool
    distance: str
    about: dict[str, Any]

    weights_hash = ""

    def embed(self, sequence: Drive, *, batch: int = 1, **options: Any) -> DescriptorFile:
        """Describe a whole sequence; options are those of `ImageMethod`, but for `batch`: scans come one at a time.

        Raises ValueError where the sequence has not the points or the labels that the method needs.
        """
        method = self.about["method"]
        if isinstance(sequence, ImageSequence):
            others = ", ".join(name for name, other in BASELINES.items() if other.input == "images")
            raise ValueError(f"{method} needs points, found only images in sequence {sequence.name}; use {others}")
        if self.labels and not sequence.has_labels:
            raise ValueError(f"{method} needs labels beside the scans, found none in sequence {sequence.name}")
        about = {"data": sequence.name, **self.about}
        return embed_scans(self.describe, sequence, config=about, distance=self.distance, labels=self.labels, **options)


Method = ImageMethod | ScanMethod


def method_named(name: MethodName, weights: str | None, sequence: Drive) -> Method:
    """The network with these weights, or a reference; ValueError for the network without weights."""
    if name != "sglpr":
        return reference(name, sequence, model_preset("small").grid)
    if weights is None:
        raise ValueError("expected --weights (a name, or a training run's folder), found none")
    return network(load(weights))


def network(params: Params) -> ImageMethod:
    """The descriptors of `params`."""
    config = params.config
    about = {"method": "sglpr", "model": dataclasses.asdict(config)}
    describe_views = functools.partial(describe, params)
    return ImageMethod(describe_views, config.grid, about, weights_hash(params), config.categories_read, config.image)


def reference(name: str, sequence: Drive, grid: Grid) -> Method:
    """A reference without training, by its name in `BASELINES`: on points, on whole images, or on `grid`."""
    if name not in BASELINES:
        raise ValueError(f"no reference method {name!r}; there are {', '.join(BASELINES)}")
    baseline = BASELINES[name]
    return _on_images(name, sequence, grid) if baseline.input == "images" else _on_points(name, baseline)


def _on_images(name: str, sequence: Drive, grid: Grid) -> ImageMethod:
    images_are_made = isinstance(sequence, ImageSequence)
    options = {"radius": BEV_IMAGE_RADIUS} if name == "polar-fft" and images_are_made else {}
    about = {"method": name} if images_are_made else {"method": name, "grid": dataclasses.asdict(grid)}
    describe = functools.partial(BASELINES[name].describe, **options)
    return ImageMethod(lambda images: describe(np.asarray(images)), None if images_are_made else grid, about)


def _on_points(name: str, baseline: Baseline) -> ScanMethod:
    labels = baseline.input == "labelled points"

    def describe_scan(points, classes):
        return baseline.describe(points, classes) if labels else baseline.describe(points)

    return ScanMethod(describe_scan, labels, baseline.distance, {"method": name})
