"""Batches of a run in order, read by a thread while the device works, but only up to the next refresh of mining."""

import abc
import collections
import concurrent.futures
from collections.abc import Callable, Generator
from typing import Any, TypeVar

from sglpr_jax.training.step import TrainState

T = TypeVar("T")


class BatchSource(abc.ABC):
    """Source of the batches of a run. Subclasses define `batch`."""

    refresh_steps: int = 0
    """Number of steps between calls of `refresh`, or 0 for no refresh. No batch at or after a refresh step may be
    requested before that call."""

    @abc.abstractmethod
    def batch(self, step: int) -> Any:
        """Return this host's part of the batch of a step. Repeated calls return the same batch."""

    def refresh(self, step: int, state: TrainState) -> None:  # noqa: B027 (most sources need no state)
        """Give the source the state before a step. The batches from that step on may depend on it."""

    def places(self, step: int) -> str:
        """Describe the places in the batch of a step, for error messages."""
        return ""


class BatchQueue:
    """Iterator over the batches of the steps from `start` to `stop - 1`.

    `prepare` must be called before each `next`. `place` moves a batch to where the step needs it, for example to the
    devices. It runs in the prefetching thread.
    """

    def __init__(
        self, source: BatchSource, *, start: int, stop: int, place: Callable[[Any], Any] = lambda batch: batch
    ):
        self._source, self._place = source, place
        self._next, self._stop = start, stop
        self._ahead = self._read(start if source.refresh_steps else stop)

    def prepare(self, state: Callable[[], TrainState]) -> None:
        """Refresh the source with the current state if the next step requires it."""
        every = self._source.refresh_steps
        if not every or self._next < self._end:
            return
        self._ahead.close()
        self._source.refresh(self._next, state())
        self._ahead = self._read(self._next - self._next % every + every)

    def __next__(self) -> Any:
        batch = next(self._ahead)
        self._next += 1
        return batch

    def close(self) -> None:
        """Stop the prefetching thread."""
        self._ahead.close()

    def _read(self, end: int) -> Generator[Any, None, None]:
        self._end = min(end, self._stop)
        return read_ahead(lambda step: self._place(self._source.batch(step)), start=self._next, stop=self._end)


def read_ahead(make: Callable[[int], T], *, start: int, stop: int, depth: int = 2) -> Generator[T, None, None]:
    """Yield make(start), ..., make(stop - 1) in order. A thread computes up to `depth` values ahead.

    An exception of `make` is raised when its value is due. Closing the iterator stops the thread.
    """
    with concurrent.futures.ThreadPoolExecutor(1, thread_name_prefix="read-ahead") as pool:
        ahead = collections.deque(pool.submit(make, step) for step in range(start, min(start + depth, stop)))
        try:
            for step in range(start, stop):
                made = ahead.popleft().result()
                if step + depth < stop:
                    ahead.append(pool.submit(make, step + depth))
                yield made
        finally:
            pool.shutdown(cancel_futures=True)
