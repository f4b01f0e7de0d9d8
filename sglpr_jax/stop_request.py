"""Orderly end of a command: the first Ctrl-C or SIGTERM asks its work to stop, so that nothing is lost."""

import contextlib
import dataclasses
import signal
import sys
from collections.abc import Iterator
from typing import NoReturn


@dataclasses.dataclass
class StopRequest:
    """Whether a signal asked the work to stop, and which one. `request()` returns True after such a signal."""

    signal: int | None = None
    """SIGINT (Ctrl-C) or SIGTERM, or None before a signal."""

    def __call__(self) -> bool:
        return self.signal is not None

    @property
    def exit_status(self) -> int:
        """130 after Ctrl-C, as in shells. 0 after SIGTERM, which ends a run that will be resumed later."""
        return 130 if self.signal == signal.SIGINT else 0

    def exit(self, message: str) -> NoReturn:
        """Print the message on stderr and exit with the status of the signal."""
        print(message, file=sys.stderr, flush=True)
        sys.exit(self.exit_status)


@contextlib.contextmanager
def stop_on_signal() -> Iterator[StopRequest]:
    """Turn the first Ctrl-C or SIGTERM in the block into a stop request. A second one raises KeyboardInterrupt.

    At the end of the block the previous signal handlers are restored.
    """
    request = StopRequest()

    def handle_signal(number, _frame):
        if request():
            raise KeyboardInterrupt
        request.signal = number
        print("stopping after this step; repeat to stop at once", file=sys.stderr)

    previous_handlers = {number: signal.signal(number, handle_signal) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield request
    finally:
        for number, handler in previous_handlers.items():
            signal.signal(number, handler)
