"""A run's measurements as TensorBoard's event files (extra `tensorboard`), beside its metrics."""

import contextlib
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from sglpr_jax.files import writing

EVENTS = "tensorboard"


@contextlib.contextmanager
def event_writer(folder: Path) -> Iterator[Callable[[int, Mapping[str, float]], None]]:
    """A function of (step, measurements) that writes them under `folder`, at once.

    The first step it is told hides what an interrupted run wrote of that step and later ones. Raises ImportError where
    the extra is not installed, OSError where the files cannot be written.
    """
    try:  # not its SummaryWriter: that writes from a thread, where an error is lost
        from tensorboardX.event_file_writer import EventsWriter
        from tensorboardX.proto.event_pb2 import Event, SessionLog  # pyright: ignore[reportAttributeAccessIssue] - generated
        from tensorboardX.proto.summary_pb2 import Summary  # pyright: ignore[reportAttributeAccessIssue]
    except ImportError as error:
        raise ImportError("event files need the extra tensorboard: pip install 'sglpr-jax[tensorboard]'") from error
    writer = None

    def record(step: int, values: Mapping[str, float]) -> None:
        nonlocal writer
        scalars = [Summary.Value(tag=name, simple_value=value) for name, value in values.items()]
        with writing(folder):
            if writer is None:
                folder.mkdir(parents=True, exist_ok=True)
                writer = EventsWriter(str(folder / "events"))
                writer.write_event(Event(step=step, session_log=SessionLog(status=SessionLog.START)))
            writer.write_event(Event(wall_time=time.time(), step=step, summary=Summary(value=scalars)))
            writer.flush()

    try:
        yield record
    finally:
        if writer is not None:
            with writing(folder):
                writer.close()
