"""Training time of a run of `bin/train`, added up over its stages."""

from collections.abc import Iterator, Mapping
from pathlib import Path

from sglpr_jax.training.callbacks import Callback
from sglpr_jax.training.loop import METRICS_FILE
from sglpr_jax.training.metrics_log import read_metrics

SPEED = "steps_per_second"
UPRIGHT = "upright"
"""Folder of the first stage, in that of the run."""


def stages(folder: Path) -> Iterator[Path]:
    """Yield the metrics of a run's stages, in their order."""
    yield from (path for path in (folder / UPRIGHT / METRICS_FILE, folder / METRICS_FILE) if path.is_file())


class Clock(Callback):
    """Adds up the time of the steps, without scores and compilation. The first lines after each start state no speed;
    their steps count with the mean speed."""

    def __init__(self, folder: Path, *, limit_s: float):
        """Continue the time of the stages in the folder of a run."""
        self._limit_s = limit_s
        self._timed_s, self._timed, self._steps, self._last = 0.0, 0, 0, 0
        for path in stages(folder):
            self._last = 0
            for line in read_metrics(path):
                self.on_step(int(line["step"]), line)

    @property
    def seconds(self) -> float:
        """Training time in seconds."""
        return self._timed_s * self._steps / max(self._timed, 1)

    @property
    def over(self) -> bool:
        """Whether the limit is reached."""
        return self.seconds >= self._limit_s

    def on_start(self, step: int, steps: int) -> None:
        self._last = step

    def on_step(self, step: int, values: Mapping[str, float]) -> None:
        made, self._last = step - self._last, step
        self._steps += made
        if SPEED in values:
            self._timed, self._timed_s = self._timed + made, self._timed_s + made / values[SPEED]
