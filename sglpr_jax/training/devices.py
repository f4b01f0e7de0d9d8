"""Data-parallel training: every device takes its share of a step's tuples, all hold the same weights.

The step is written as for one device. XLA sees where its arrays lie and adds what the devices must tell each other:
descriptors for the triplet loss, sums for the others, and the gradient (GSPMD). So its results are those of one device,
to float32 rounding.
"""

import sys
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import jax
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from sglpr_jax.data.sampling.batch import Batch
from sglpr_jax.training.config import TrainConfig
from sglpr_jax.training.hosts import is_first_host

AXIS = "data"
Tree = TypeVar("Tree")
Function = TypeVar("Function", bound=Callable)


def data_mesh(config: TrainConfig, devices: Sequence[Any] | None = None) -> Mesh:
    """The devices of a run in one row, host after host (default: of all there are).

    They must divide the tuples of a step and the images of a chunk. Of each host as many are used as do, the rest is
    left idle, which is said on stderr. Raises ValueError where not even one device of each host does.
    """
    by_host: dict[int, list[Any]] = {}
    for device in jax.devices() if devices is None else devices:
        by_host.setdefault(device.process_index, []).append(device)
    there = min(map(len, by_host.values()))
    shared = f"the {config.tuples} tuples of a step and the {config.images_at_once} images of a chunk"
    divisors = [n for n in range(1, there + 1) if _divides(n * len(by_host), config)]
    if not divisors:
        raise ValueError(f"expected {shared} to be divided by the number of hosts, found {len(by_host)} hosts")
    used = divisors[-1]
    if used < there and is_first_host():
        print(f"using {used} of {there} devices of each host: their number must divide {shared}", file=sys.stderr)
    row = [device for host in sorted(by_host) for device in by_host[host][:used]]
    return Mesh(np.array(row), (AXIS,), axis_types=(AxisType.Auto,))


def split(batch: Batch, mesh: Mesh) -> Batch:
    """This host's tuples, from host memory, on its devices of the mesh: its part of the batch of all hosts."""
    return _place(batch, NamedSharding(mesh, PartitionSpec(AXIS)))


def replicate(tree: Tree, mesh: Mesh) -> Tree:
    """The same arrays on every device of the mesh; every host must bring the same."""
    return _place(tree, NamedSharding(mesh, PartitionSpec()))


def own_copy(tree: Tree) -> Tree:
    """Replicated arrays as this host's first device has them, to be used without the others."""
    return jax.tree.map(lambda leaf: leaf.addressable_data(0), tree)


def on_own_rows(function: Function) -> Function:
    """Under jit: a function of rows that know nothing of each other, run by each device of the mesh on its own.

    For what XLA would bring together to do, as it does for scatters.
    """
    if not _several_devices():
        return function
    return jax.shard_map(function, in_specs=PartitionSpec(AXIS), out_specs=PartitionSpec(AXIS))


def keep_split(tree: Tree, *, axis: int) -> Tree:
    """Under jit: have `axis` of the arrays split over the devices of the mesh in force, if it has several."""
    return _constrain(tree, PartitionSpec(*[None] * axis, AXIS))


def keep_replicated(tree: Tree) -> Tree:
    """Under jit: have all of the arrays on every device of the mesh in force, if it has several."""
    return _constrain(tree, PartitionSpec())


def _constrain(tree: Tree, spec: PartitionSpec) -> Tree:
    """One device needs no constraint, so that its program is the one without a mesh."""
    return jax.lax.with_sharding_constraint(tree, spec) if _several_devices() else tree


def _several_devices() -> bool:
    mesh = jax.sharding.get_abstract_mesh()
    return not mesh.empty and mesh.size > 1


def _place(tree: Tree, sharding: NamedSharding) -> Tree:
    return jax.make_array_from_process_local_data(sharding, jax.tree.map(np.asarray, tree))


def _divides(devices: int, config: TrainConfig) -> bool:
    """A batch of two sources is not split: its places are in an order of their own."""
    if config.also_tuples:
        return devices == 1
    return config.tuples % devices == 0 and config.images_at_once % devices == 0
