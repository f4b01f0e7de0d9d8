"""Several hosts that train together: one process each, started with the same command and its own index.

The first host (index 0) alone writes what people read: metrics, weights, pictures. Each reads its own part of a batch.
"""

import contextlib
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import jax
import numpy as np
from jax.experimental import multihost_utils

SHUTDOWN_SECONDS = 60
"""How long a host that ends waits for the others before it brings them down."""
T = TypeVar("T")


@contextlib.contextmanager
def connected(*, hosts: int, host_index: int, coordinator: str | None) -> Iterator[None]:
    """Make one machine of `hosts` processes that meet at the first one's address (HOST:PORT); with one, do nothing.

    To be entered before JAX is used for anything. All hosts must leave it. Raises ValueError for an index or address
    that cannot be, ConnectionError where the hosts do not find each other or one of the others ends.
    """
    if not 0 <= host_index < hosts:
        raise ValueError(f"expected a host index from 0 to {hosts - 1}, found {host_index}")
    if hosts == 1:
        yield
        return
    if coordinator is None or not coordinator.rpartition(":")[2].isdigit():
        raise ValueError(f"{hosts} hosts need the first one's address, HOST:PORT, found {coordinator}")
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
            f"host {host_index} of {hosts} (they meet at {coordinator}) cannot go on, most likely because another host "
            f"ended; it has printed why ({error})"
        ) from error


def is_first_host() -> bool:
    """Whether this process is the one that writes."""
    return jax.process_index() == 0


def own_part(tuples: int) -> slice:
    """Which of a step's tuples this host reads: an equal share, in the order of the hosts."""
    each = tuples // jax.process_count()
    return slice(jax.process_index() * each, (jax.process_index() + 1) * each)


def on_any_host(flag: bool) -> bool:
    """Whether `flag` is set on some host. All must ask."""
    return flag if jax.process_count() == 1 else bool(multihost_utils.process_allgather(np.array(flag)).any())


def on_all_hosts(work: Callable[[], T]) -> T:
    """What `work` returns, once it is done on every host. All must ask.

    Where it raises on one, that one raises its error and the others ConnectionError, instead of waiting for it.
    """
    done: Any = None
    error: Exception | None = None
    try:
        done = work()
    except Exception as raised:
        error = raised
    if on_any_host(error is not None):
        raise error or ConnectionError("another host ended with an error; it has printed which")
    return done


def of_first_host(value: float) -> float:
    """The first host's number. All must ask."""
    return value if jax.process_count() == 1 else float(multihost_utils.broadcast_one_to_all(np.float32(value)))
