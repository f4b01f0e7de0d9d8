"""Data-parallel training: the tuples of a step are split over the devices, and all devices hold the same weights.

XLA derives the communication between devices from the placement of the arrays. Results equal those of one device, to
float32 rounding. Each of several hosts has one process, which reads its part of a batch. Only the first writes files.
"""

import contextlib
import math
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from sglpr_jax.training.config import TrainConfig

AXIS = "data"
SHUTDOWN_SECONDS = 60
"""Time that a host waits at the end for the others, in seconds. After it, the host terminates them."""
T = TypeVar("T")
Tree = TypeVar("Tree")
Function = TypeVar("Function", bound=Callable)


def data_mesh(config: TrainConfig, devices: Sequence[Any] | None = None) -> Mesh:
    """Arrange the devices of a run (default: all) in one row, host after host.

    The number of devices must divide the tuples of a step and the images of a chunk. Each host uses the largest
    possible number. Idle devices are reported on stderr. Raises ValueError if one device per host is too many.
    """
    devices_by_host: dict[int, list[Any]] = {}
    for device in jax.devices() if devices is None else devices:
        devices_by_host.setdefault(device.process_index, []).append(device)
    hosts, available = len(devices_by_host), min(map(len, devices_by_host.values()))
    work = f"the {config.tuples} tuples of a step and the {config.images_at_once} images of a chunk"
    divisible = math.gcd(config.tuples, config.images_at_once)
    if config.also_tuples:
        divisible, work = 1, "1 (a batch of two datasets stays on one device)"
    used = max((n for n in range(1, available + 1) if divisible % (n * hosts) == 0), default=0)
    if not used:
        raise ValueError(f"expected {work} to be divisible by the number of hosts, found {hosts} hosts")
    if used < available and is_first_host():
        print(f"using {used} of {available} devices of each host: their number must divide {work}", file=sys.stderr)
    row = [device for host in sorted(devices_by_host) for device in devices_by_host[host][:used]]
    return Mesh(np.array(row), (AXIS,), axis_types=(AxisType.Auto,))


def split_over_devices(batch: Tree, mesh: Mesh) -> Tree:
    """Move this host's tuples to its devices of the mesh. Together, the hosts then hold one batch."""
    return _to_devices(batch, NamedSharding(mesh, PartitionSpec(AXIS)))


def replicate(tree: Tree, mesh: Mesh) -> Tree:
    """Copy the arrays to every device of the mesh. All hosts must pass the same arrays."""
    return _to_devices(tree, NamedSharding(mesh, PartitionSpec()))


def host_copy(tree: Tree) -> Tree:
    """Return replicated arrays as they are on this host's first device. Using them does not involve other hosts."""
    return jax.tree.map(lambda leaf: leaf.addressable_data(0), tree)


def per_device(function: Function) -> Function:
    """Under jit: return a function with which each device computes only the rows of the batch that it holds.

    `function` must treat every row alone. Use this where XLA would gather all rows on a device, as for scatters.
    """
    if not _has_several_devices():
        return function
    return jax.shard_map(function, in_specs=PartitionSpec(AXIS), out_specs=PartitionSpec(AXIS))


def keep_sharding(tree: Tree, *, axis: int | None = None) -> Tree:
    """Under jit: keep `axis` of the arrays split over the devices. None: keep the arrays replicated on each device."""
    if not _has_several_devices():
        return tree
    unsplit_axes = [None] * (axis or 0)
    spec = PartitionSpec() if axis is None else PartitionSpec(*unsplit_axes, AXIS)
    return jax.lax.with_sharding_constraint(tree, spec)


def _has_several_devices() -> bool:
    """Return whether the mesh of the current `jax.set_mesh` has more than one device."""
    mesh = jax.sharding.get_abstract_mesh()
    return not mesh.empty and mesh.size > 1


def _to_devices(tree: Tree, sharding: NamedSharding) -> Tree:
    return jax.make_array_from_process_local_data(sharding, jax.tree.map(np.asarray, tree))


@contextlib.contextmanager
def connected(*, hosts: int, host_index: int, coordinator: str | None) -> Iterator[None]:
    """Connect the processes of `hosts` hosts to one JAX cluster, before any other use of JAX. The end waits for all.

    Raises ValueError if the index or the address (HOST:PORT) is invalid, and ConnectionError if the hosts do not find
    each other, or if another host ends.
    """
    if not 0 <= host_index < hosts:
        raise ValueError(f"expected a host index from 0 to {hosts - 1}, found {host_index}")
    if hosts == 1:
        yield
        return
    if coordinator is None or not re.fullmatch(r".+:\d+", coordinator):
        raise ValueError(f"{hosts} hosts need a coordinator: expected the first host's HOST:PORT, found {coordinator}")
    try:
        jax.distributed.initialize(
            coordinator,
            hosts,
            host_index,
            cluster_detection_method="deactivate",
            shutdown_timeout_seconds=SHUTDOWN_SECONDS,
        )
        yield
        jax.distributed.shutdown()
    except jax.errors.JaxRuntimeError as error:
        raise ConnectionError(
            f"host {host_index} of {hosts} (coordinator {coordinator}) cannot continue; probably another host "
            f"ended; see the error that it printed ({error})"
        ) from error


def is_first_host() -> bool:
    """Whether this process runs on the first host, the only one that writes files."""
    return jax.process_index() == 0


def host_slice(tuples: int) -> slice:
    """Return the part of the `tuples` of a step that this host reads. Hosts read equal parts, in their order."""
    host_tuples = tuples // jax.process_count()
    start = jax.process_index() * host_tuples
    return slice(start, start + host_tuples)


def any_host(flag: bool) -> bool:
    """Return whether `flag` is set on any host. All hosts must call this function."""
    return flag if jax.process_count() == 1 else bool(multihost_utils.process_allgather(np.array(flag)).any())


def on_all_hosts(work: Callable[[], T]) -> T:
    """Run `work` on this host, wait for the other hosts, and return its result. All hosts must call this function.

    If `work` fails on a host, that host raises its error and the others raise ConnectionError.
    """
    result: Any = None
    error: Exception | None = None
    try:
        result = work()
    except Exception as raised:
        error = raised
    if any_host(error is not None):
        raise error or ConnectionError("another host ended with an error; see the message that it printed")
    return result
