"""Append-only file of records, from which a run that was killed goes on.

Each record has a number, its length and a checksum. A damaged record is skipped, and the gap in the numbers shows it.
The end of an unfinished record is removed when the file is read.
"""

import mmap
import os
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

from sglpr_jax.files import writing

HEAD = struct.Struct("<4sIII")
"""Bytes before a record: `MARK`, number, length, and CRC-32 of the record that begins with the CRC of its number."""
MARK = b"\x93FR1"
"""Beginning of each record. The next record after a damaged one is found by it."""


class FrameLog:
    """Records of a file, with ascending numbers.

    Example:
      log = FrameLog(path)
      for number, record in log.records(): ...   # those of an earlier process
      log.append(number, record)
    """

    def __init__(self, path: Path):
        """Open a log, or begin a new one in an existing folder. Raises WriteError if the file cannot be written."""
        self.path = path
        self.cut = 0
        """Number of bytes that `records` removed from the end."""
        with writing(path, path):
            self._file = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_BINARY", 0), 0o644)
        self._size = os.fstat(self._file).st_size

    def records(self) -> Iterator[tuple[int, bytes]]:
        """Yield number and content of each whole record. Raises ValueError if the file is no log."""
        if not self._size:
            return
        at = end = 0
        with mmap.mmap(self._file, 0, access=mmap.ACCESS_READ) as content:
            ours = content[: len(MARK)] == MARK
            while (at := content.find(MARK, at)) >= 0:
                record = _record(content, at)
                if record is None:
                    at += 1
                    continue
                yield record
                at = end = at + HEAD.size + len(record[1])
        if not ours and not end:
            raise ValueError(f"{self.path}: expected a log of frames, found another file")
        self.cut = self._size - end
        self._truncate(end)

    def append(self, number: int, record: bytes) -> None:
        """Add a record. It survives a kill of the process, and with `sync` a loss of power.

        Raises WriteError if it cannot be written, for instance on a full disk. The file then stays as it was.
        """
        content = memoryview(HEAD.pack(MARK, number, len(record), _checksum(number, record)) + record)
        with writing(self.path):
            os.lseek(self._file, self._size, os.SEEK_SET)
            try:
                done = 0
                while done < len(content):
                    done += os.write(self._file, content[done:])
            except OSError:
                self._truncate(self._size)
                raise
        self._size += len(content)

    def sync(self) -> None:
        """Wait until the disk has all records."""
        with writing(self.path):
            os.fsync(self._file)

    def close(self) -> None:
        """Write everything to the disk and close the file."""
        try:
            self.sync()
        finally:
            os.close(self._file)

    def _truncate(self, size: int) -> None:
        with writing(self.path):
            os.ftruncate(self._file, size)
        self._size = size


def _record(content: mmap.mmap, at: int) -> tuple[int, bytes] | None:
    """Number and content of the record at a position, or None if it is cut or damaged."""
    if len(content) - at < HEAD.size:
        return None
    _, number, length, checksum = HEAD.unpack_from(content, at)
    record = content[at + HEAD.size : at + HEAD.size + length]
    whole = len(record) == length and _checksum(number, record) == checksum
    return (number, record) if whole else None


def _checksum(number: int, record: bytes) -> int:
    return zlib.crc32(record, zlib.crc32(number.to_bytes(4, "little")))
