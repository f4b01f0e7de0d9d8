"""The batches of a run in order, read ahead, but never past a refresh of what negatives are mined by."""

from collections.abc import Callable, Generator

from sglpr_jax.data.batch import Batch
from sglpr_jax.data.loader import read_ahead
from sglpr_jax.models.sglpr import Params

RefreshFn = Callable[[int, Params], None]
"""Takes note of the weights before a step; the batches from that step on may depend on them."""


class Batches:
    """An iterator over make_batch(start), ..., make_batch(stop - 1) that has to be told of refreshes."""

    def __init__(
        self,
        make_batch: Callable[[int], Batch],
        *,
        start: int,
        stop: int,
        refresh: RefreshFn | None = None,
        refresh_steps: int = 1,
    ):
        """Without `refresh` everything is read ahead; with it `prepare` must be called before every step."""
        self._make_batch, self._refresh, self._refresh_steps = make_batch, refresh, refresh_steps
        self._next, self._stop = start, stop
        self._ahead = self._read(stop if refresh is None else start)

    def prepare(self, params: Params) -> None:
        """Refresh what the coming batches are made by, where that is due; `params` are the present weights."""
        if self._refresh is None or self._next < self._end:
            return
        self._ahead.close()
        self._refresh(self._next, params)
        self._ahead = self._read(self._next - self._next % self._refresh_steps + self._refresh_steps)

    def __next__(self) -> Batch:
        batch = next(self._ahead)
        self._next += 1
        return batch

    def close(self) -> None:
        """End the thread that reads."""
        self._ahead.close()

    def _read(self, end: int) -> Generator[Batch, None, None]:
        self._end = min(end, self._stop)
        return read_ahead(self._make_batch, start=self._next, stop=self._end)
