"""Batches of a run in order. They are prefetched, but only up to the next refresh of the mined negatives."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Generator

from sglpr_jax.data.sampling.batch import Batch
from sglpr_jax.data.sampling.read_ahead import read_ahead
from sglpr_jax.models.params import Params


class BatchSource(ABC):
    """Source of the batches of a run."""

    refresh_steps: int = 0
    """Number of steps between calls of `refresh`, or 0 for no refresh. No batch at or after a refresh step may be
    requested before that call."""

    @abstractmethod
    def batch(self, step: int) -> Batch:
        """Return this host's part of the batch of a step. Repeated calls return the same batch."""

    def refresh(self, step: int, params: Params) -> None:
        """Give the source the weights before a step. The batches from that step on may depend on these weights."""
        return None  # default: the batches do not depend on the weights

    def places(self, step: int) -> str:
        """Describe the places in the batch of a step, for error messages."""
        return ""


class BatchQueue:
    """Iterator over the batches of the steps from `start` to `stop - 1`.

    `prepare` must be called before each `next`. `place` moves a batch to where the step needs it, for example to the
    devices. It runs in the prefetching thread.
    """

    def __init__(
        self, source: BatchSource, *, start: int, stop: int, place: Callable[[Batch], Batch] = lambda batch: batch
    ):
        self._source, self._place = source, place
        self._next, self._stop = start, stop
        self._ahead = self._read(start if source.refresh_steps else stop)

    def prepare(self, params: Params) -> None:
        """Refresh the source if the next step requires it. `params` are the current weights."""
        every = self._source.refresh_steps
        if not every or self._next < self._end:
            return
        self._ahead.close()
        self._source.refresh(self._next, params)
        self._ahead = self._read(self._next - self._next % every + every)

    def __next__(self) -> Batch:
        batch = next(self._ahead)
        self._next += 1
        return batch

    def close(self) -> None:
        """Stop the prefetching thread."""
        self._ahead.close()

    def _read(self, end: int) -> Generator[Batch, None, None]:
        self._end = min(end, self._stop)
        return read_ahead(lambda step: self._place(self._source.batch(step)), start=self._next, stop=self._end)
