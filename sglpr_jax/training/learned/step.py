"""One training step of a learned method: a pure function, compiled once for all learning rates."""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int, Shaped

from sglpr_jax.data.sampling.tuples import TuplePool
from sglpr_jax.methods.learned.method import LearnedMethod, Tuples, Variables
from sglpr_jax.methods.learned.weights_file import random_variables


class State(NamedTuple):
    """State of a training between two steps."""

    step: Int[Any, ""]
    """Number of finished steps."""
    variables: Variables
    moments: Any
    """State of the optimiser."""


class Batch(NamedTuple):
    """Tuples of one step. All their places are in one array, tuple after tuple."""

    inputs: Shaped[Any, "b ..."]
    apart_m: Float[Any, "t k"]
    """Distance of each place from the anchor of its tuple, in metres. Infinite between recordings."""


def new_state(method: LearnedMethod, *, seed: int) -> State:
    """Return the state before the first step, with random weights."""
    variables = random_variables(method, seed=seed)
    return State(jnp.int32(0), variables, _adam(method).init(variables["params"]))


@functools.partial(jax.jit, static_argnames="method")
def train_step(
    state: State, batch: Batch, key: Array, learning_rate: Float[Any, ""], *, method: LearnedMethod
) -> tuple[State, Float[Array, ""]]:
    """Return the state after a step, and the loss of its batch before the step.

    Arguments:
      state: State before the step.
      batch: Tuples of the step.
      key: Random key of the run. The step number is folded in.
      learning_rate: Learning rate of Adam.
      method: Method to train. Its weight decay is added to the gradient, as in PyTorch's Adam.
    """
    inputs = method.turned(jax.random.fold_in(key, state.step), batch.inputs)
    params, rest = state.variables["params"], {k: v for k, v in state.variables.items() if k != "params"}

    def loss_of(params):
        described, updated = method.network.apply({"params": params, **rest}, inputs, train=True, mutable=[*rest])
        descriptors = described.reshape(*batch.apart_m.shape, -1)
        tuples = Tuples(descriptors, batch.apart_m, method.recipe.sampling.positives)
        return method.loss({"params": params, **updated}, tuples), updated

    (loss, updated), gradient = jax.value_and_grad(loss_of, has_aux=True)(params)
    change, moments = _adam(method).update(gradient, state.moments, params)
    params = jax.tree.map(lambda value, by: value - learning_rate * by, params, change)
    return State(state.step + 1, {**rest, **updated, "params": params}, moments), loss


def distances_from_anchors(pool: TuplePool, frames: Int[np.ndarray, "t k"]) -> Float[np.ndarray, "t k"]:
    """Return the horizontal distance of each place from the anchor of its tuple, in metres. Infinite between
    recordings."""
    offset = pool.positions[frames, :2] - pool.positions[frames[:, :1], :2]
    same = pool.recording[frames] == pool.recording[frames[:, :1]]
    return np.where(same, np.hypot(offset[..., 0], offset[..., 1]), np.inf).astype(np.float32)


def _adam(method: LearnedMethod) -> optax.GradientTransformation:
    """Adam without the learning rate, so that one compiled step serves every rate."""
    return optax.chain(optax.add_decayed_weights(method.recipe.weight_decay), optax.scale_by_adam())
