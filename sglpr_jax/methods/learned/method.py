"""Interface of a learned method: its network, input, loss and the settings of its training."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from flax import linen as nn
from jaxtyping import Array, Float, Shaped

from sglpr_jax.data.recording import Record
from sglpr_jax.data.sampling.config import TupleConfig
from sglpr_jax.methods.method import Takes

Variables = Mapping[str, Any]
"""Variables of a network: `params`, and `batch_stats` if it has batch normalisation."""


class Tuples(NamedTuple):
    """Descriptors of a training batch. Column 0 is the anchor; positives and negatives follow."""

    descriptors: Float[Array, "t k d"]
    apart_m: Float[Array, "t k"]
    """Distance of each place from the anchor, in metres. Infinite between recordings."""
    positives: int
    """Number of positives of each anchor."""


@runtime_checkable
class Compare(Protocol):
    """Distance of descriptors that needs the weights of the network."""

    def __call__(
        self, variables: Variables, queries: Float[Array, "q d"], database: Float[Array, "n d"]
    ) -> Float[Array, "q n"]:
        """Return the distances. Smaller distances mean more similar places."""
        ...


@dataclass(frozen=True)
class Recipe:
    """Settings of the training."""

    published: str
    """Training of the authors, in words: optimiser, loss, tuples, duration."""
    sampling: TupleConfig
    tuples: int
    """Number of tuples in a step."""
    learning_rates: tuple[float, float, float]
    """Learning rates of the search, smallest first. The second one is the published one, if that is known."""
    weight_decay: float = 0.0


@dataclass(frozen=True)
class LearnedMethod:
    """A network of another publication, as declared by its file in `learned/`.

    The network is a linen module. `network.apply(variables, inputs, train=False)` returns one descriptor for each
    input. With `train=True` and `mutable=["batch_stats"]` it updates the statistics of its batch normalisation. Weights
    start at random, also where the publication starts from ImageNet.
    """

    name: str
    """Name on the command line."""
    source: str
    """Publication of the method."""
    licence: str
    """Licence of the authors' code, for example "MIT", or "GPL-3.0, not read"."""
    takes: Takes
    """Content that `prepare` needs in a record. Methods that take images accept ready-made images and scans."""
    weights: int
    """Number of trained weights."""
    network: nn.Module
    prepare: Callable[[Record], Shaped[np.ndarray, "..."]]
    """Makes the input of the network from a record. All inputs have one shape and type."""
    turned: Callable[[Array, Shaped[Array, "b ..."]], Shaped[Array, "b ..."]]
    """`turned(key, inputs)` rotates each input about the vertical axis by its own random angle, for the training."""
    loss: Callable[[Variables, Tuples], Float[Array, ""]]
    recipe: Recipe
    compare: Compare | None = None
    """Distance of descriptors, if it is learned. None: L2."""
    start: Callable[[Variables, Shaped[np.ndarray, "n ..."]], Variables] | None = None
    """Changes random weights before the first step, for example to clusters of local features. It receives the inputs
    of random training places. None: the weights stay as they are."""
