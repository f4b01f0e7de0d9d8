"""The batches of a run in order, read ahead, but never past a refresh of what negatives are mined by."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Generator

from sglpr_jax.data.sampling.batch import Batch
from sglpr_jax.data.sampling.read_ahead import read_ahead
from sglpr_jax.models.params import Params


class BatchSource(ABC):
    """Where the batches of a run come from."""

    refresh_steps: int = 0
    """Every so many steps `refresh` has to be called, before any batch from there on is asked for; 0: never."""

    @abstractmethod
    def batch(self, step: int) -> Batch:
        """Return this host's part of the batch of a step, the same each time it is asked."""

    def refresh(self, step: int, params: Params) -> None:
        """Take note of the weights before `step`: the batches from that step on may depend on them."""
        return None  # most sources have nothing to refresh

    def places(self, step: int) -> str:
        """Name the places of a step's batch, for an error."""
        return ""


class BatchQueue:
    """An iterator over the batches of the steps from `start` to `stop`; `prepare` must be called before each of them.

    `place` puts a batch where the step wants it, on the devices say; it runs in the thread that reads ahead.
    """

    def __init__(
        self, source: BatchSource, *, start: int, stop: int, place: Callable[[Batch], Batch] = lambda batch: batch
    ):
        self._source, self._place = source, place
        self._next, self._stop = start, stop
        self._ahead = self._read(start if source.refresh_steps else stop)

    def prepare(self, params: Params) -> None:
        """Refresh what the coming batches are made by, where that is due; `params` are the present weights."""
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
        """End the thread that reads."""
        self._ahead.close()

    def _read(self, end: int) -> Generator[Batch, None, None]:
        self._end = min(end, self._stop)
        return read_ahead(lambda step: self._place(self._source.batch(step)), start=self._next, stop=self._end)
