"""Reads serialised ROS messages field by field. rosbags is slower, because it creates an object for each part.

ROS 1 packs the fields without padding, in little-endian order. ROS 2 (CDR) begins with four bytes that contain the byte
order. After them, each number is aligned to its size.
"""

from typing import NamedTuple

import numpy as np


class Header(NamedTuple):
    """std_msgs/Header."""

    time: float
    """Timestamp in seconds."""
    frame: str


class RosMessage:
    """A message and a read position. Reading beyond the end raises ValueError."""

    def __init__(self, raw: bytes, *, cdr: bool):
        self._raw = raw
        self._cdr = cdr
        self._order = ">" if cdr and not raw[1] & 1 else "<"
        self._at = 4 if cdr else 0

    def numbers(self, kind: str, count: int = 1) -> np.ndarray:
        """Read the next `count` numbers of a type such as "f8"."""
        return self._next(np.dtype(f"{self._order}{kind}"), count)

    def text(self) -> str:
        """Read the next string."""
        length = int(self.numbers("u4")[0])
        return self.numbers("u1", length).tobytes().rstrip(b"\0").decode(errors="replace")

    def header(self) -> Header:
        """Read the header at the start of a sensor message."""
        if not self._cdr:
            self.numbers("u4")  # sequence number of ROS 1
        seconds, nanoseconds = int(self.numbers("i4")[0]), int(self.numbers("u4")[0])
        return Header(seconds + nanoseconds / 1e9, self.text())

    def records(self, fields: dict[str, str]) -> np.ndarray:
        """Read the next sequence of records. Fields of 4 bytes must precede fields of 1 byte."""
        count = int(self.numbers("u4")[0])
        packed = np.dtype([(name, f"{self._order}{kind}") for name, kind in fields.items()])
        padding = -packed.itemsize % 4 if self._cdr else 0
        names, offsets = list(fields), [packed.fields[name][1] for name in fields]  # pyright: ignore
        formats, size = [packed[name] for name in names], packed.itemsize + padding
        padded = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": size})
        found = self._next(padded, max(count - 1, 0))  # the last record has no padding
        return np.concatenate([found, self._next(packed, min(count, 1)).astype(found.dtype)])

    def _next(self, kind: np.dtype, count: int) -> np.ndarray:
        size = 1 if kind.names else kind.itemsize
        self._at += -(self._at - 4) % size if self._cdr else 0
        end = self._at + count * kind.itemsize
        if end > len(self._raw):
            raise ValueError(f"expected {count} times {kind.itemsize} bytes, found {len(self._raw) - self._at}")
        found = np.frombuffer(self._raw, kind, count, self._at) if count else np.zeros(0, kind)
        self._at = end
        return found
