"""Training on several hosts, with one process each. Every host runs the same command with its own index.

Only the first host (index 0) writes metrics, weights and pictures. Each host reads its own part of a batch.
"""

import contextlib
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import jax
import numpy as np
from jax.experimental import multihost_utils

SHUTDOWN_SECONDS = 60
"""Time that a host waits at the end for the others, in seconds. After it, the host terminates them."""
T = TypeVar("T")


@contextlib.contextmanager
def connected(*, hosts: int, host_index: int, coordinator: str | None) -> Iterator[None]:
    """Connect the processes of `hosts` hosts to one JAX cluster. With one host, do nothing.

    Enter the context before any other use of JAX. All hosts must leave it.

    Arguments:
      hosts: Number of hosts.
      host_index: Index of this host, from 0.
      coordinator: Address of the first host, as HOST:PORT.

    Raises:
      ValueError: The index or the address is invalid.
      ConnectionError: The hosts do not find each other, or another host ends.
    """
    if not 0 <= host_index < hosts:
        raise ValueError(f"expected a host index from 0 to {hosts - 1}, found {host_index}")
    if hosts == 1:
        yield
        return
    if coordinator is None or not coordinator.rpartition(":")[2].isdigit():
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


def own_part(tuples: int) -> slice:
    """Return the slice of a step's tuples that this host reads: equal parts, in the order of the hosts."""
    each = tuples // jax.process_count()
    return slice(jax.process_index() * each, (jax.process_index() + 1) * each)


def on_any_host(flag: bool) -> bool:
    """Whether `flag` is set on any host. All hosts must call this function."""
    return flag if jax.process_count() == 1 else bool(multihost_utils.process_allgather(np.array(flag)).any())


def on_all_hosts(work: Callable[[], T]) -> T:
    """Run `work` on this host, wait for the other hosts, and return its result. All hosts must call this function.

    If `work` fails on a host, that host raises its error and the others raise ConnectionError.
    """
    done: Any = None
    error: Exception | None = None
    try:
        done = work()
    except Exception as raised:
        error = raised
    if on_any_host(error is not None):
        raise error or ConnectionError("another host ended with an error; see the message that it printed")
    return done


def of_first_host(value: float) -> float:
    """Return the first host's value on every host. All hosts must call this function."""
    return value if jax.process_count() == 1 else float(multihost_utils.broadcast_one_to_all(np.float32(value)))
