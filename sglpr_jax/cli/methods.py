"""The methods a descriptor can come from, as functions of images: the network, and references without training."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from sglpr_jax.bev import Grid
from sglpr_jax.data import Drive, ImageSequence
from sglpr_jax.evaluation.baselines.polar_fft import polar_fft
from sglpr_jax.evaluation.baselines.thumbnail import thumbnail
from sglpr_jax.models.params import weights_hash
from sglpr_jax.models.sglpr import Params, describe
from sglpr_jax.retrieval.descriptor_file import DescriptorFile
from sglpr_jax.retrieval.embed import DescribeFn, embed

BEV_IMAGE_RADIUS = 62.0
"""Pixels from the centre to which the ready-made KITTI images have content."""


@dataclasses.dataclass(frozen=True)
class Method:
    """A way to describe images: the function, the window it wants (None: images whole), and what to write about it."""

    describe: DescribeFn
    grid: Grid | None
    about: dict[str, Any]
    weights_hash: str = ""

    def embed(self, sequence: Drive, **options: Any) -> DescriptorFile:
        """Describe a whole sequence; options are those of `retrieval.embed.embed`."""
        about = {"data": sequence.name, **self.about}
        return embed(self.describe, sequence, self.grid, config=about, weights_hash=self.weights_hash, **options)


def network(params: Params) -> Method:
    """The descriptors of `params`."""
    about = {"method": "sglpr", "model": dataclasses.asdict(params.config)}
    return Method(functools.partial(describe, params), params.config.grid, about, weights_hash(params))


def reference(name: str, sequence: Drive, grid: Grid) -> Method:
    """A reference without training, on whole images or on `grid`: `polar-fft` or `thumbnail`."""
    images_are_made = isinstance(sequence, ImageSequence)
    radius = BEV_IMAGE_RADIUS if images_are_made else None
    functions: dict[str, Callable] = {"polar-fft": functools.partial(polar_fft, radius=radius), "thumbnail": thumbnail}
    if name not in functions:
        raise ValueError(f"no reference method {name!r}; there are {', '.join(functions)}")
    about = {"method": name} if images_are_made else {"method": name, "grid": dataclasses.asdict(grid)}
    return Method(lambda images: functions[name](np.asarray(images)), None if images_are_made else grid, about)
