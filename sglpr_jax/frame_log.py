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
          records = [log.record(frame) for frame in range(log.end)]    # of an earlier process; None if damaged
          log.append(len(records), record)
    """

    def __init__(self, path: Path | None, settings: Mapping[str, Any], *, restarts: bool = False):
        """Open a log, or begin one. Without a path, nothing is stored.

        Arguments:
          path: The file. Missing folders are created.
          settings: JSON values that determine the frames.
          restarts: Whether a log with other settings is begun anew, with a `DataWarning`. If the settings are damaged,
            the old file is kept as `NAME.damaged`.

        Raises ValueError if the file is no log or, without `restarts`, if its settings are others or damaged. Raises
        WriteError if the file cannot be written.
        """
        self.path = path
        self.damaged_bytes = 0
        """Number of bytes of damaged and unfinished records."""
        self._settings: dict[str, Any] = json.loads(json.dumps(settings))  # as parsed: tuples are lists
        self._file, self._size, self._copies = -1, 0, 0
        self._places: dict[int, _Place] = {}
        if path is not None:
            try:
                self._open(path, restarts=restarts)
            except BaseException:
                self._close_file()
                raise

    def __enter__(self) -> "FrameLog":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def end(self) -> int:
        """Number of frames of earlier processes, up to the last whole one."""
        return max(self._places, default=-1) + 1

    def record(self, frame: int) -> bytes | None:
        """Return the latest whole record of a frame by an earlier process, or None."""
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
        try:
            self.sync()
        finally:
            self._close_file()

    def _open(self, path: Path, *, restarts: bool) -> None:
        """Open the file, find its frames, and check or write the settings."""
        with raising_write_error(path, *path.parents):
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_BINARY", 0), 0o644)
        self._size = os.fstat(self._file).st_size
        stored = self._find_frames(path) if self._size else self._settings
        if stored != self._settings:
            found = "damaged ones" if stored is None else f"another {self._changed(stored)}"
            problem = f"{path}: expected a log with the same settings, found {found}"
            if not restarts:
                raise ValueError(f"{problem}; use the settings of the log, or another folder")
            warn(f"{problem}; restarting")
            self._restart(path, keep=stored is None)
        if not self._copies:
            self._append_settings()

    def _find_frames(self, path: Path) -> dict[str, Any] | None:
        """Find the whole records of the file. Return the settings of the file, or None if they are damaged.

        A file that was killed or lost power before its first frame has those of this run. Raises ValueError if the file
        is no log.
        """
        stored, self.damaged_bytes = None, self._size
        with mmap.mmap(self._file, 0, access=mmap.ACCESS_READ) as content:
            for number, place in _whole_records(content):
                self.damaged_bytes -= HEAD.size + place.length
                if number == SETTINGS:
                    self._copies += 1
                    settings = parse_json(content[place.begin : place.begin + place.length], source=path)
                    stored = settings if isinstance(settings, dict) else None
                else:
                    self._places[number - 1] = place
            beginning = content[: len(MARK)]
        if stored is None and not self._places:
            is_unfinished = MARK.startswith(beginning) and self._size < HEAD.size + len(json.dumps(self._settings))
            if is_unfinished or not any(beginning):  # after a power failure, a file may hold zeros
                return self._settings
            if beginning != MARK:
                raise ValueError(f"{path}: expected a log of frames, found another file")
        return stored

    def _changed(self, stored: dict[str, Any]) -> str:
        """Return the names of the settings that differ from those of the file."""
        return ", ".join(name for name, value in self._settings.items() if stored.get(name) != value) or "version"

    def _restart(self, path: Path, *, keep: bool) -> None:
        """Begin the file anew. With `keep`, the old one is renamed."""
        self._close_file()
        with raising_write_error(path, path):
            if keep:
                path.replace(path.with_name(f"{path.name}.damaged"))
            else:
                path.unlink()
            self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0), 0o644)
        self._size, self.damaged_bytes, self._copies, self._places = 0, 0, 0, {}

    def _close_file(self) -> None:
        """Close the file, if it is open."""
        if self._file >= 0:
            os.close(self._file)
        self._file = -1

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
        is_inside = begin + length <= len(content)
        if is_inside and _checksum(number, content[begin : begin + length]) == checksum:
            yield number, _Place(begin, length)
            position = begin + length
        else:
            position += 1


def _checksum(number: int, record: bytes) -> int:
    """CRC-32 of the number as 4 bytes (little-endian) and the record."""
    return zlib.crc32(record, zlib.crc32(number.to_bytes(4, "little")))
