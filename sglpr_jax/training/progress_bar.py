"""Progress of a training run on stderr: a bar, or lines if there is no terminal."""

import sys
from collections.abc import Mapping

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from sglpr_jax.training.callbacks import Callback
from sglpr_jax.training.loss import MEASURES, TERM_NAMES

_SHOWN = ("loss", *TERM_NAMES, *MEASURES, "steps_per_second")


class ProgressBar(Callback):
    """Shows finished steps, remaining time and the latest measurements.

    Without a terminal it prints a line for each call of `on_step`.
    """

    def __init__(self):
        self._progress: Progress | None = None
        self._tasks: dict[str, TaskID] = {}
        self._steps = 0

    def on_pack(self, recording: str, done: int, scans: int) -> None:
        """Show how many scans of the recording are packed."""
        self._show(f"pack {recording}", done, scans)

    def on_start(self, step: int, steps: int) -> None:
        """Show the number of finished steps."""
        self._steps = steps
        self._show("train", step, steps)

    def on_step(self, step: int, values: Mapping[str, float]) -> None:
        """Show the step and its measurements."""
        terms = "  ".join(f"{name} {values[name]:.3g}" for name in _SHOWN if name in values)
        self._show("train", step, None, terms=terms)
        if self._progress is not None and self._progress.disable:
            print(f"step {step} of {self._steps}: {terms}", file=sys.stderr, flush=True)

    def close(self) -> None:
        """Stop the bar and leave it on the screen."""
        if self._progress is not None:
            self._progress.stop()
            self._progress = None
            self._tasks.clear()  # the next training run gets new bars

    def _show(self, title: str, done: int, total: int | None, *, terms: str = "") -> None:
        if self._progress is None:
            self._progress = _progress()
            self._progress.start()
        if title not in self._tasks:
            self._tasks[title] = self._progress.add_task(title, total=total, terms="")
        self._progress.update(self._tasks[title], completed=done, terms=terms)


def _progress() -> Progress:
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    return Progress(*columns, TextColumn("{task.fields[terms]}"), console=console, disable=not console.is_terminal)
