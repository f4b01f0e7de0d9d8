"""Data-parallel training: the tuples of a step are split over the devices, and all devices hold the same weights.

The step is written for one device. XLA derives the communication from the placement of the arrays (GSPMD): descriptors
for the triplet loss, sums for the other losses, and the gradient. The results are those of one device, to float32
rounding.
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
    """Arrange the devices of a run (default: all) in one row, host after host.

    Their number must divide the tuples of a step and the images of a chunk. Each host uses the largest possible number.
    Idle devices are reported on stderr. Raises ValueError if one device per host is already too many.
    """
    by_host: dict[int, list[Any]] = {}
    for device in jax.devices() if devices is None else devices:
        by_host.setdefault(device.process_index, []).append(device)
    there = min(map(len, by_host.values()))
    shared = f"the {config.tuples} tuples of a step and the {config.images_at_once} images of a chunk"
    divisors = [n for n in range(1, there + 1) if _divides(n * len(by_host), config)]
    if not divisors:
        raise ValueError(f"expected {shared} to be divisible by the number of hosts, found {len(by_host)} hosts")
    used = divisors[-1]
    if used < there and is_first_host():
        print(f"using {used} of {there} devices of each host: their number must divide {shared}", file=sys.stderr)
    row = [device for host in sorted(by_host) for device in by_host[host][:used]]
    return Mesh(np.array(row), (AXIS,), axis_types=(AxisType.Auto,))


def split(batch: Batch, mesh: Mesh) -> Batch:
    """Place this host's tuples on its devices of the mesh, as its part of the batch of all hosts."""
    return _place(batch, NamedSharding(mesh, PartitionSpec(AXIS)))


def replicate(tree: Tree, mesh: Mesh) -> Tree:
    """Copy the arrays to every device of the mesh. All hosts must pass the same arrays."""
    return _place(tree, NamedSharding(mesh, PartitionSpec()))


def own_copy(tree: Tree) -> Tree:
    """Return this host's copy of replicated arrays, from its first device. It can be used without the other hosts."""
    return jax.tree.map(lambda leaf: leaf.addressable_data(0), tree)


def on_own_rows(function: Function) -> Function:
    """Under jit: let each device of the mesh apply a row-wise function to its own rows.

    Use it for operations for which XLA would gather all rows, such as scatters.
    """
    if not _several_devices():
        return function
    return jax.shard_map(function, in_specs=PartitionSpec(AXIS), out_specs=PartitionSpec(AXIS))


def keep_split(tree: Tree, *, axis: int) -> Tree:
    """Under jit: keep `axis` of the arrays split over the devices of the current mesh, if it has several."""
    return _constrain(tree, PartitionSpec(*[None] * axis, AXIS))


def keep_replicated(tree: Tree) -> Tree:
    """Under jit: keep the arrays replicated on every device of the current mesh, if it has several."""
    return _constrain(tree, PartitionSpec())


def _constrain(tree: Tree, spec: PartitionSpec) -> Tree:
    """Constrain the sharding on several devices. On one device the program stays the one without a mesh."""
    return jax.lax.with_sharding_constraint(tree, spec) if _several_devices() else tree


def _several_devices() -> bool:
    mesh = jax.sharding.get_abstract_mesh()
    return not mesh.empty and mesh.size > 1


def _place(tree: Tree, sharding: NamedSharding) -> Tree:
    return jax.make_array_from_process_local_data(sharding, jax.tree.map(np.asarray, tree))


def _divides(devices: int, config: TrainConfig) -> bool:
    """Whether a step can be split over this many devices. Mixed batches of two datasets are never split."""
    if config.also_tuples:
        return devices == 1
    return config.tuples % devices == 0 and config.images_at_once % devices == 0
