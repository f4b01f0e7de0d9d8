"""Hooks that run during training: progress display, logs of measurements, curves."""

import contextlib
from collections.abc import Mapping


class Callback:
    """Follows a training run. Subclasses override the methods that they need. The methods of this class do nothing.

    If several hosts train together, only the first host calls them.

    Example:
      class PrintScores(Callback):
          def on_score(self, step, scores):
              print(step, scores)
    """

    def on_pack(self, recording: str, done: int, scans: int) -> None:
        """Called while `train` packs a recording (`cache`): `done` of its `scans` are packed."""

    def on_start(self, step: int, steps: int) -> None:
        """Called before the first step: `step` of `steps` steps are already done."""

    def on_step(self, step: int, values: Mapping[str, float]) -> None:
        """Called every `log_every` steps with means since the last call: the loss, its terms, norms and speed."""

    def on_score(self, step: int, scores: Mapping[str, float]) -> None:
        """Called every `score_every` steps with the scores of the weights. The entry "score" selects the best
        checkpoint."""

    def on_checkpoint(self, step: int) -> None:
        """Called when a checkpoint of the weights after this step is being written."""

    def on_end(self, step: int) -> None:
        """Called after the last step, or after this step if the run was asked to stop. The weights are saved."""

    def close(self) -> None:
        """Close open files. This is the last call, also after an error."""


class Callbacks(Callback):
    """Combines several callbacks. Each method calls them in order."""

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
        """Close all callbacks in order, even if one of them raises an error."""
        with contextlib.ExitStack() as closing:
            for callback in reversed(self._callbacks):
                closing.callback(callback.close)
