"""Append-only log of records, from which a run that was killed resumes.

Each record has a number, its length and a checksum. A damaged record is skipped, so that its number is missing. An
unfinished record at the end is removed when the file is read.
"""

import json
import mmap
import os
import struct
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from sglpr_jax.files import append_whole, parse_json, raising_write_error, warn

HEAD = struct.Struct("<4sIII")
"""Bytes before a record: `MARK`, number of the record, its length, and the CRC-32 of number and record."""
MARK = b"\x93FR1"
"""First bytes of each record, for finding the next record after a damaged one."""


SETTINGS_COPIES = 2
"""Number of copies of the settings in a `RunLog`."""


class FrameLog:
    """Append-only file with a numbered record for each frame.

    Example:
      log = FrameLog(path)
      for number, record in log.records(): ...   # records of an earlier process
      log.append(number, record)
    """

    def __init__(self, path: Path):
        """Open a log, or begin a new one in an existing folder. Raises WriteError if the file cannot be written."""
        self.path = path
        self.removed_bytes = 0
        """Number of bytes that `records` removed from the end."""
        with raising_write_error(path, path):
            self._file = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_BINARY", 0), 0o644)
        self._size = os.fstat(self._file).st_size

    def records(self) -> Iterator[tuple[int, bytes]]:
        """Yield number and content of each whole record, then remove the bytes after the last one.

        Raises ValueError if the file is no log.
        """
        if not self._size:
            return
        position = end = 0
        with mmap.mmap(self._file, 0, access=mmap.ACCESS_READ) as content:
            is_log = content[: len(MARK)] == MARK
            while (position := content.find(MARK, position)) >= 0:
                record = _record(content, position)
                if record is None:
                    position += 1
                    continue
                yield record
                position = end = position + HEAD.size + len(record[1])
        if not is_log and not end:
            raise ValueError(f"{self.path}: expected a log of frames, found another file")
        self.removed_bytes = self._size - end
        self.truncate(end)

    def append(self, number: int, record: bytes) -> None:
        """Add a record. The record survives a kill of the process, and after `sync` also a power failure.

        Raises WriteError if the record cannot be written, for instance on a full disk. The file then stays as it was.
        """
        content = HEAD.pack(MARK, number, len(record), _checksum(number, record)) + record
        with raising_write_error(self.path):
            append_whole(self._file, content, size=self._size)
        self._size += len(content)

    @property
    def has_content(self) -> bool:
        """Whether the file has records."""
        return self._size > 0

    def sync(self) -> None:
        """Wait until the disk has all records."""
        with raising_write_error(self.path):
            os.fsync(self._file)

    def close(self) -> None:
        """Write everything to the disk and close the file."""
        try:
            self.sync()
        finally:
            os.close(self._file)

    def truncate(self, size: int) -> None:
        """Remove everything after the first `size` bytes."""
        with raising_write_error(self.path):
            os.ftruncate(self._file, size)
        self._size = size


class RunLog:
    """Log with one record per step of a run. A run that was killed resumes after its last complete step.

    Record 0 of the file contains the settings of the run as JSON, twice, because without them all steps are lost.
    Record n + 1 contains step n.

    Example:
      with RunLog(path, settings) as log:
          steps = log.records            # steps of an earlier process
          log.append(len(steps), record)
    """

    def __init__(self, path: Path | None, settings: Mapping[str, Any]):
        """Open or create a log. `settings` are the JSON values that determine the steps. `path` None stores nothing.

        Records of other settings are deleted, with a `DataWarning`. Raises ValueError if the file is no log, WriteError
        if it cannot be written.
        """
        self.records: list[bytes] = []
        """Steps of an earlier process."""
        self.path, self._log = path, None
        if path is None:
            return
        with raising_write_error(path, *path.parents):
            path.parent.mkdir(parents=True, exist_ok=True)
        self._log = FrameLog(path)
        records: list[bytes] = []
        for number, record in self._log.records():
            if number <= len(records):  # a larger number follows a damaged record
                records[number:] = [record]  # a repeated step replaces that step and all after it
        settings = json.loads(json.dumps(settings))  # as parsed: tuples are lists
        if not records and self._log.has_content:
            warn(f"{path}: expected a checkpoint with its settings, found damaged ones; restarting")
        stored = parse_json(records[0], source=path) if records else {}
        if stored == settings:
            self.records = records[1:]
            return
        if records:
            changed = ", ".join(name for name in settings if stored.get(name) != settings[name])
            warn(f"{path}: expected a checkpoint with the same settings, found another {changed}; restarting")
        self._log.truncate(0)
        for _ in range(SETTINGS_COPIES):
            self._log.append(0, json.dumps(settings).encode())

    def __enter__(self) -> "RunLog":
        return self

    def __exit__(self, *_: object) -> None:
        if self._log is not None:
            self._log.close()

    def append(self, step: int, record: bytes) -> None:
        """Add the record of a step, counted from 0. It replaces this step of an earlier process and all after it.

        Raises WriteError if the record cannot be written.
        """
        if self._log is not None:
            self._log.append(step + 1, record)


def _record(content: mmap.mmap, position: int) -> tuple[int, bytes] | None:
    """Number and content of the record that begins at a byte of a file, or None if it is unfinished or damaged."""
    if len(content) - position < HEAD.size:
        return None
    _, number, length, checksum = HEAD.unpack_from(content, position)
    record = content[position + HEAD.size : position + HEAD.size + length]
    is_whole = len(record) == length and _checksum(number, record) == checksum
    return (number, record) if is_whole else None


def _checksum(number: int, record: bytes) -> int:
    """CRC-32 of the number as 4 bytes (little-endian) and the record."""
    return zlib.crc32(record, zlib.crc32(number.to_bytes(4, "little")))
