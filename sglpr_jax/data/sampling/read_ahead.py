"""Reads the next batches in a thread while the device processes the current batch."""

import queue
import threading
from collections.abc import Callable, Generator
from typing import TypeVar

T = TypeVar("T")


def read_ahead(make: Callable[[int], T], *, start: int, stop: int, depth: int = 2) -> Generator[T, None, None]:
    """Yield make(start), ..., make(stop - 1) in order. A thread computes up to `depth` values ahead.

    An exception of `make` is raised when its value is due. Closing the iterator stops the thread.
    """
    ready: queue.Queue = queue.Queue(maxsize=depth)
    ended = threading.Event()

    def put(item) -> bool:
        while not ended.is_set():
            try:
                ready.put(item, timeout=0.1)
                return True
            except queue.Full:
                continue
        return False

    def work():
        for step in range(start, stop):
            try:
                item = (make(step), None)
            except BaseException as error:  # The consumer raises it.
                item = (None, error)
            if not put(item) or item[1] is not None:
                return

    thread = threading.Thread(target=work, name="read-ahead", daemon=True)
    thread.start()
    try:
        for _ in range(start, stop):
            value, error = ready.get()
            if error is not None:
                raise error
            yield value
    finally:
        ended.set()
        thread.join()
