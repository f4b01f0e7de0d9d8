"""Callbacks of a training: the progress on stderr, and event files for TensorBoard."""

import contextlib
import functools
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from rich.console import Console

from sglpr_jax.extras import optional_module
from sglpr_jax.files import raising_write_error
from sglpr_jax.progress import progress_bar
from sglpr_jax.training.loss_terms import TERM_NAMES

EVENTS = "tensorboard"
_SHOWN = ("loss", *TERM_NAMES, "violations", "steps_per_second")
"""Measurements that the progress bar shows."""


class Callback:
    """Follows a training run. Subclasses override the methods that they need. The methods of this class do nothing.

    If several hosts train together, only the first host calls them.

    Example:
      class PrintScores(Callback):
          def on_score(self, step, scores):
              print(step, scores)
    """

    def on_pack(self, recording: str, done: int, scans: int) -> None:
        """Called while `train` writes a recording to its `cache`: `done` of its `scans` are written."""

    def on_start(self, step: int, steps: int) -> None:
        """Called before the first step: `step` of `steps` steps are already done."""

    def on_step(self, step: int, values: Mapping[str, float]) -> None:
        """Called every `log_every` steps with means since the last call: the loss, its terms, norms and speed."""

    def on_score(self, step: int, scores: Mapping[str, float]) -> None:
        """Called every `score_every` steps with the scores of the weights."""

    def on_end(self, step: int) -> None:
        """Called after the last step, or after this step if the run was asked to stop. The weights are saved."""

    def close(self) -> None:
        """Close open files. This is the last call, also after an error."""


class Callbacks(Callback):
    """Combines several callbacks. Each method calls them in order."""

    def __init__(self, *callbacks: Callback):
        self._callbacks = callbacks
        for name in ("on_pack", "on_start", "on_step", "on_score", "on_end"):
            setattr(self, name, functools.partial(self._call_each, name))

    def close(self) -> None:
        """Close all callbacks in order, even if one of them raises an error."""
        with contextlib.ExitStack() as exit_stack:  # calls in reverse order
            for callback in reversed(self._callbacks):
                exit_stack.callback(callback.close)

    def _call_each(self, name: str, *arguments: Any) -> None:
        for callback in self._callbacks:
            getattr(callback, name)(*arguments)


class ProgressBar(Callback):
    """Shows finished steps, remaining time and the latest measurements.

    Without a terminal it prints a line at the start, and one for each call of `on_step`.
    """

    def __init__(self):
        self._open_bar = contextlib.ExitStack()
        self._title, self._steps = "", 0
        self._show: Callable[..., None] = lambda done, text="": None

    def on_pack(self, recording: str, done: int, scans: int) -> None:
        self._open_once(f"pack {recording}", scans)
        self._show(done)

    def on_start(self, step: int, steps: int) -> None:
        self._steps = steps
        self._open_once("train", steps)
        self._show_step(step, "compiling the first step")

    def on_step(self, step: int, values: Mapping[str, float]) -> None:
        self._show_step(step, "  ".join(f"{name} {values[name]:.3g}" for name in _SHOWN if name in values))

    def close(self) -> None:
        self._open_bar.close()
        self._title = ""

    def _show_step(self, step: int, text: str) -> None:
        self._show(step, text)
        if not Console(stderr=True).is_terminal:
            print(f"step {step} of {self._steps}: {text}", file=sys.stderr, flush=True)

    def _open_once(self, title: str, total: int) -> None:
        """Replace the bar by one with this title, unless it is open."""
        if title != self._title:
            self._open_bar.close()
            self._title, self._show = title, self._open_bar.enter_context(progress_bar(title, total))


class EventFiles(Callback):
    """Writes all measurements into event files of TensorBoard in a folder.

    Raises ImportError if the extra is not installed. Writing raises OSError if the files cannot be written.
    """

    def __init__(self, folder: Path):
        optional_module("tensorboardX", "writing of event files", extra="tensorboard")
        self._folder = folder
        self._writer: Any = None

    def close(self) -> None:
        if self._writer is not None:
            with raising_write_error(self._folder):
                self._writer.close()
            self._writer = None

    def on_step(self, step: int, values: Mapping[str, float]) -> None:
        from tensorboardX.proto.event_pb2 import Event  # pyright: ignore[reportAttributeAccessIssue] - generated
        from tensorboardX.proto.summary_pb2 import Summary  # pyright: ignore[reportAttributeAccessIssue]

        scalars = [Summary.Value(tag=name, simple_value=value) for name, value in values.items()]
        with raising_write_error(self._folder):
            self._writer = self._writer or _new_writer(self._folder, step)
            self._writer.write_event(Event(wall_time=time.time(), step=step, summary=Summary(value=scalars)))
            self._writer.flush()

    def on_score(self, step: int, scores: Mapping[str, float]) -> None:
        self.on_step(step, scores)


def _new_writer(folder: Path, step: int) -> Any:
    """Open an event file. Its START record makes TensorBoard hide records of an earlier process from `step` on."""
    # tensorboardX's SummaryWriter writes from a thread, where errors are lost.
    from tensorboardX.event_file_writer import EventsWriter
    from tensorboardX.proto.event_pb2 import Event, SessionLog  # pyright: ignore[reportAttributeAccessIssue]

    folder.mkdir(parents=True, exist_ok=True)
    writer = EventsWriter(str(folder / "events"))
    writer.write_event(Event(step=step, session_log=SessionLog(status=SessionLog.START)))
    return writer
