"""Queue of one item between a receiving thread and the node: a newer scan replaces one that waits."""

import threading
from typing import Generic, TypeVar

T = TypeVar("T")


class Latest(Generic[T]):
    """The newest item. `put` replaces an item that waits and counts it as dropped.

    Example:
      latest = Latest()
      latest.put(frame)              # in the receiving thread
      frame = latest.take(0.2)       # in the node: None after 0.2 s without an item
    """

    def __init__(self):
        self._item: T | None = None
        self._dropped = 0
        self._changed = threading.Condition()

    @property
    def dropped(self) -> int:
        """Number of items that were replaced before they were taken."""
        return self._dropped

    def put(self, item: T) -> None:
        """Make this the newest item."""
        with self._changed:
            self._dropped += self._item is not None
            self._item = item
            self._changed.notify()

    def take(self, timeout: float) -> T | None:
        """Remove and return the newest item, or return None after `timeout` seconds without one."""
        with self._changed:
            self._changed.wait_for(lambda: self._item is not None, timeout)
            item, self._item = self._item, None
            return item
