"""What can be done while a training runs, beside training: show how far it is, write measurements, draw curves."""

import contextlib
from collections.abc import Mapping


class Callback:
    """Follows a training. Its methods are called as the training goes on, and do nothing unless they are overridden.

    Where several hosts train together, only the first one calls them.

    Example:
      class PrintScores(Callback):
          def on_score(self, step, scores):
              print(step, scores)
    """

    def on_pack(self, recording: str, done: int, scans: int) -> None:
        """A recording is being packed (`train`'s `cache`): `done` of its `scans` are."""

    def on_start(self, step: int, steps: int) -> None:
        """The loop begins: `step` of `steps` steps are made already."""

    def on_step(self, step: int, values: Mapping[str, float]) -> None:
        """Every `log_every` steps: the means since the last time of the loss, its terms, norms and the speed."""

    def on_score(self, step: int, scores: Mapping[str, float]) -> None:
        """Every `score_every` steps: the scores of the weights; "score" tells the best checkpoint."""

    def on_checkpoint(self, step: int) -> None:
        """The weights after this step are being written as a checkpoint."""

    def on_end(self, step: int) -> None:
        """All steps are made, or the run was asked to stop after this one; its weights are saved."""

    def close(self) -> None:
        """Close what is open: the last call, after an error too."""


class Callbacks(Callback):
    """Several callbacks as one; each method calls theirs, in their order."""

    def __init__(self, *callbacks: Callback):
        self._callbacks = callbacks

    def on_pack(self, recording: str, done: int, scans: int) -> None:
        for callback in self._callbacks:
            callback.on_pack(recording, done, scans)

    def on_start(self, step: int, steps: int) -> None:
        for callback in self._callbacks:
            callback.on_start(step, steps)

    def on_step(self, step: int, values: Mapping[str, float]) -> None:
        for callback in self._callbacks:
            callback.on_step(step, values)

    def on_score(self, step: int, scores: Mapping[str, float]) -> None:
        for callback in self._callbacks:
            callback.on_score(step, scores)

    def on_checkpoint(self, step: int) -> None:
        for callback in self._callbacks:
            callback.on_checkpoint(step)

    def on_end(self, step: int) -> None:
        for callback in self._callbacks:
            callback.on_end(step)

    def close(self) -> None:
        """Close all, the first one first, even where one of them raises."""
        with contextlib.ExitStack() as closing:
            for callback in reversed(self._callbacks):
                closing.callback(callback.close)
