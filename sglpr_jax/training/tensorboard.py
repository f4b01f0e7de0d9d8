"""Measurements of a run as TensorBoard event files (extra `tensorboard`)."""

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sglpr_jax.files import writing
from sglpr_jax.training.callbacks import Callback

EVENTS = "tensorboard"


class EventFiles(Callback):
    """Writes all measurements into event files in a folder, without delay.

    The first record hides what an interrupted run wrote for this step and later ones. Raises ImportError if the extra
    is not installed. Writing raises OSError if the files cannot be written.
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
    # tensorboardX's SummaryWriter writes from a thread, where errors are lost.
    from tensorboardX.event_file_writer import EventsWriter
    from tensorboardX.proto.event_pb2 import Event, SessionLog  # pyright: ignore[reportAttributeAccessIssue]

    folder.mkdir(parents=True, exist_ok=True)
    writer = EventsWriter(str(folder / "events"))
    writer.write_event(Event(step=step, session_log=SessionLog(status=SessionLog.START)))
    return writer
