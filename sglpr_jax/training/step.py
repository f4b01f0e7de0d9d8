"""One training step of any network: a pure function of state and batch."""

import functools
from typing import Any, NamedTuple, Protocol, runtime_checkable

import flax.struct
import jax
import optax
from jaxtyping import Array, Float

from sglpr_jax.training.devices import keep_sharding

Metrics = dict[str, Float[Array, ""]]


@flax.struct.dataclass
class TrainState:
    """State of a run between two steps."""

    step: Any
    """Number of finished steps."""
    params: Any
    """`Params` of the network of this package, or the parameters of a learned method."""
    optimizer: Any
    """State of the optimiser: the moments of Adam."""
    statistics: Any = flax.struct.field(default_factory=dict)
    """Variables that change without a gradient: the statistics of batch normalisation."""


class Gradient(NamedTuple):
    """Result of the forward and the backward pass of a step."""

    gradient: Any
    """Derivative of the loss by `TrainState.params`."""
    statistics: Any
    """New `TrainState.statistics`."""
    metrics: Metrics
    """The loss and other measurements, by name."""


@runtime_checkable
class PlaceNetwork(Protocol):
    """A network with its loss and its optimiser. It must be hashable: `train_step` is compiled for each network."""

    @property
    def seed(self) -> int:
        """Seed of the random choices of a step."""
        ...

    @property
    def images(self) -> int:
        """Images per step."""
        ...

    @property
    def optimizer(self) -> optax.GradientTransformation:
        """Optimiser of the parameters."""
        ...

    def new_state(self) -> TrainState:
        """Return the state before the first step, with random weights."""
        ...

    def gradient(self, state: TrainState, batch: Any, key: Array) -> Gradient:
        """Return the gradient of the loss of a batch. `key` differs from step to step."""
        ...


@functools.partial(jax.jit, static_argnames="network", donate_argnames="state")
def train_step(state: TrainState, batch: Any, *, network: PlaceNetwork) -> tuple[TrainState, Metrics]:
    """Return the next state, and the metrics: those of the loss, and the norms of gradient, update and weights.

    The arrays of `state` are reused for the new state, so the caller must not use them afterwards.
    """
    key = jax.random.fold_in(jax.random.key(network.seed), state.step)
    gradient, statistics, metrics = network.gradient(state, batch, key)
    updates, optimizer = network.optimizer.update(gradient, state.optimizer, state.params)
    params = optax.apply_updates(state.params, updates)
    norms = {"gradient_norm": gradient, "update_norm": updates, "weight_norm": params}
    metrics = metrics | {name: optax.tree.norm(tree) for name, tree in norms.items()}
    return keep_sharding(TrainState(state.step + 1, params, optimizer, statistics)), metrics
