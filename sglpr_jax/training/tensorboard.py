"""A run's measurements as TensorBoard's event files (extra `tensorboard`), beside its metrics."""

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sglpr_jax.files import writing
from sglpr_jax.training.callbacks import Callback

EVENTS = "tensorboard"


class EventFiles(Callback):
    """Writes all that is measured into event files under a folder, at once.

    The first step hides what an interrupted run wrote of that step and later ones. Raises ImportError where the extra
    is not installed; writing raises OSError where the files cannot be written.
    """

    def __init__(self, folder: Path):
        try:
            import tensorboardX  # noqa: F401
        except ImportError as error:
            raise ImportError("event files need the extra tensorboard: pip install 'sglpr-jax[tensorboard]'") from error
        self._folder = folder
        self._writer: Any = None

    def on_step(self, step: int, values: Mapping[str, float]) -> None:
        """Write the measurements of a step."""
        self._write(step, values)

    def on_score(self, step: int, scores: Mapping[str, float]) -> None:
        """Write the scores after a step."""
        self._write(step, scores)

    def close(self) -> None:
        """Close the file."""
        if self._writer is not None:
            with writing(self._folder):
                self._writer.close()
            self._writer = None

    def _write(self, step: int, values: Mapping[str, float]) -> None:
        from tensorboardX.proto.event_pb2 import Event  # pyright: ignore[reportAttributeAccessIssue] - generated
        from tensorboardX.proto.summary_pb2 import Summary  # pyright: ignore[reportAttributeAccessIssue]

        scalars = [Summary.Value(tag=name, simple_value=value) for name, value in values.items()]
        with writing(self._folder):
            if self._writer is None:
                self._writer = _new_writer(self._folder, step)
            self._writer.write_event(Event(wall_time=time.time(), step=step, summary=Summary(value=scalars)))
            self._writer.flush()


def _new_writer(folder: Path, step: int) -> Any:
    # Not tensorboardX's SummaryWriter: that one writes from a thread, where an error is lost.
    from tensorboardX.event_file_writer import EventsWriter
    from tensorboardX.proto.event_pb2 import Event, SessionLog  # pyright: ignore[reportAttributeAccessIssue]

    folder.mkdir(parents=True, exist_ok=True)
    writer = EventsWriter(str(folder / "events"))
    writer.write_event(Event(step=step, session_log=SessionLog(status=SessionLog.START)))
    return writer
