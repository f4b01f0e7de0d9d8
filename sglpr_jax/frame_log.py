"""Append-only log of the frames of a run, from which a run that was killed resumes.

Each record has a number, its length and a checksum. A damaged or unfinished record costs its own frame: reading goes on
at the next mark, and nothing is removed from the file.
"""

import json
import mmap
import os
import struct
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from sglpr_jax.files import append_whole, parse_json, raising_write_error, warn

HEAD = struct.Struct("<4sIII")
"""Bytes before a record: `MARK`, number of the record, its length, and the CRC-32 of number and record."""
MARK = b"\x93FR1"
"""First bytes of each record, for finding the next record after a damaged one."""
SETTINGS = 0
"""Number of the records with the settings. The record of frame n has the number n + 1."""
SETTINGS_COPIES = 2
"""Number of records with the settings, because without them all frames are lost. The second one follows the first
frame, so that one damaged block of a disk does not hold both."""


class _Place(NamedTuple):
    """Place of a whole record in the file, in bytes."""

    begin: int
    length: int


class FrameLog:
    """Append-only file with the settings of a run as JSON and a record for each frame.

    Example:
      with FrameLog(path, settings) as log:
          for frame in range(log.end):       # frames of an earlier process
              record = log.record(frame)     # None if it is damaged
          log.append(log.end, record)
    """

    def __init__(self, path: Path | None, settings: Mapping[str, Any], *, restarts: bool = False):
        """Open a log, or begin one. Without a path, nothing is stored.

        Arguments:
          path: The file. Missing folders are created.
          settings: JSON values that determine the frames.
          restarts: Whether a log with other settings is begun anew, with a `DataWarning`. If the settings are damaged,
            the old file is kept as `NAME.damaged`.

        Raises ValueError if the file is no log, if the settings are damaged or, without `restarts`, if they are others.
        Raises WriteError if the file cannot be written.
        """
        self.path = path
        self.damaged_bytes = 0
        """Number of bytes of damaged and unfinished records."""
        self._settings: dict[str, Any] = json.loads(json.dumps(settings))  # as parsed: tuples are lists
        self._file, self._size, self._copies = -1, 0, 0
        self._places: dict[int, _Place] = {}
        if path is None:
            return
        with raising_write_error(path, *path.parents):
            path.parent.mkdir(parents=True, exist_ok=True)
        self._open(path)
        try:
            problem = self._problem(path)
            if problem is not None and not restarts:
                raise ValueError(f"{problem}; use the settings of the log, or another folder")
        except ValueError:
            os.close(self._file)
            raise
        if problem is not None:
            warn(f"{problem}; restarting")
            self._restart(path)
        if not self._copies:
            self._append_settings()

    def __enter__(self) -> "FrameLog":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def end(self) -> int:
        """Number of frames up to the last whole one."""
        return max(self._places, default=-1) + 1

    def record(self, frame: int) -> bytes | None:
        """Return the record of a frame that an earlier process appended last, or None if there is no whole one."""
        place = self._places.get(frame)
        if place is None:
            return None
        os.lseek(self._file, place.begin, os.SEEK_SET)
        content = b""
        while len(content) < place.length and (part := os.read(self._file, place.length - len(content))):
            content += part
        return content

    def append(self, frame: int, record: bytes) -> None:
        """Add the record of a frame. It survives a kill of the process, and after `sync` also a power failure.

        Raises WriteError if the record cannot be written, for instance on a full disk. The file then stays as it was.
        """
        if self.path is not None:
            self._append(frame + 1, record)
            if self._copies < SETTINGS_COPIES:
                self._append_settings()

    def sync(self) -> None:
        """Wait until the disk has all records."""
        if self.path is not None:
            with raising_write_error(self.path):
                os.fsync(self._file)

    def close(self) -> None:
        """Write everything to the disk and close the file."""
        if self.path is not None:
            try:
                self.sync()
            finally:
                os.close(self._file)

    def _open(self, path: Path) -> None:
        """Open the file and find its whole records."""
        with raising_write_error(path, path):
            self._file = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_BINARY", 0), 0o644)
        self._size = self.damaged_bytes = os.fstat(self._file).st_size
        self._copies, self._places = 0, {}

    def _problem(self, path: Path) -> str | None:
        """Find the frames of the file. Return why they cannot be used with the settings, or None.

        Raises ValueError if the file is no log.
        """
        if not self._size:
            return None
        stored = None
        with mmap.mmap(self._file, 0, access=mmap.ACCESS_READ) as content:
            for number, place in _whole_records(content):
                self.damaged_bytes -= HEAD.size + place.length
                if number != SETTINGS:
                    self._places[number - 1] = place
                    continue
                self._copies += 1
                stored = parse_json(content[place.begin : place.begin + place.length], source=path)
            if stored is None and not self._places:
                if MARK.startswith(content[: len(MARK)]):
                    return None  # killed while it wrote its first record
                raise ValueError(f"{path}: expected a log of frames, found another file")
        if stored == self._settings:
            return None
        if not isinstance(stored, dict):
            return f"{path}: expected a log with its settings, found damaged ones"
        changed = ", ".join(name for name, value in self._settings.items() if stored.get(name) != value) or "version"
        return f"{path}: expected a log with the same settings, found another {changed}"

    def _restart(self, path: Path) -> None:
        """Begin the file anew. A file with damaged settings is kept."""
        os.close(self._file)
        with raising_write_error(path, path):
            if self._copies:
                path.unlink()
            else:
                path.replace(path.with_name(f"{path.name}.damaged"))
        self._open(path)

    def _append_settings(self) -> None:
        self._append(SETTINGS, json.dumps(self._settings).encode())
        self._copies += 1

    def _append(self, number: int, record: bytes) -> None:
        """Add a record with a number."""
        assert self.path is not None
        content = HEAD.pack(MARK, number, len(record), _checksum(number, record)) + record
        with raising_write_error(self.path):
            append_whole(self._file, content, size=self._size)
        self._size += len(content)


def _whole_records(content: mmap.mmap) -> Iterator[tuple[int, _Place]]:
    """Yield number and place of each record of a file that is neither damaged nor unfinished."""
    position = 0
    while (position := content.find(MARK, position)) >= 0:
        begin = position + HEAD.size
        if begin > len(content):
            return
        _, number, length, checksum = HEAD.unpack_from(content, position)
        record = content[begin : begin + length]
        if len(record) == length and _checksum(number, record) == checksum:
            yield number, _Place(begin, length)
            position = begin + length
        else:
            position += 1


def _checksum(number: int, record: bytes) -> int:
    """CRC-32 of the number as 4 bytes (little-endian) and the record."""
    return zlib.crc32(record, zlib.crc32(number.to_bytes(4, "little")))
