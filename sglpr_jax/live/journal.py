"""Append-only file of the scans of a live map. A process that is killed loses nothing that it has written.

Each record has its length and a checksum. A record that is cut or damaged ends the file; it is removed when the file is
opened. The first record holds the settings.
"""

import json
import os
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from sglpr_jax.files import parse_json, writing

HEAD = 8
"""Bytes before a record: its length and its CRC-32, as unsigned little-endian numbers of 4 bytes."""
LONGEST = 1 << 28
"""Maximum length of a record, in bytes."""


class Journal:
    """Records of a file, in order.

    Example:
      journal = Journal(path, settings)
      for record in journal.records(): ...   # those of an earlier process
      journal.append(record)
    """

    def __init__(self, path: Path, settings: dict[str, Any]):
        """Open a journal, or begin a new one.

        Raises:
          ValueError: If the journal has other settings, or the file is no journal.
          WriteError: If the file cannot be written.
        """
        self.path = path
        self.cut = 0
        """Number of bytes that were removed from the end, because their record was not complete."""
        with writing(path, path.parent):
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        self._size = os.fstat(self._file).st_size
        first = self._record(0)
        if first is not None:
            _check(first, settings, path)
        elif (
            self._size > HEAD + len(text := json.dumps(settings).encode()) and os.pread(self._file, 1, HEAD) != text[:1]
        ):
            raise ValueError(f"{path}: expected the journal of a live map, found another file")
        else:
            self._truncate(0)
            self.append(json.dumps(settings).encode())

    def records(self) -> Iterator[bytes]:
        """Yield the records after the settings. Removes the end of the file from the first damaged record on."""
        at = HEAD + len(self._record(0) or b"")
        while (record := self._record(at)) is not None:
            yield record
            at += HEAD + len(record)
        self.cut = self._size - at
        self._truncate(at)

    def append(self, record: bytes) -> None:
        """Add a record. It survives a kill of the process, and with `sync` a loss of power.

        Raises WriteError if it cannot be written, for instance on a full disk. The file then stays as it was.
        """
        content = memoryview(len(record).to_bytes(4, "little") + zlib.crc32(record).to_bytes(4, "little") + record)
        with writing(self.path):
            try:
                done = 0
                while done < len(content):
                    done += os.pwrite(self._file, content[done:], self._size + done)
            except OSError:
                os.ftruncate(self._file, self._size)
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

    def _record(self, at: int) -> bytes | None:
        """The record at a position, or None if it is missing, cut or damaged."""
        head = os.pread(self._file, HEAD, at)
        length = int.from_bytes(head[:4], "little")
        if len(head) < HEAD or not 0 < length <= LONGEST:
            return None
        record = os.pread(self._file, length, at + HEAD)
        whole = len(record) == length and zlib.crc32(record).to_bytes(4, "little") == head[4:]
        return record if whole else None

    def _truncate(self, size: int) -> None:
        if size < self._size:
            with writing(self.path):
                os.ftruncate(self._file, size)
        self._size = size


def _check(record: bytes, settings: dict[str, Any], path: Path) -> None:
    """Raise ValueError if the settings of a journal are not those that are wanted."""
    found, wanted = parse_json(record, source=path), json.loads(json.dumps(settings))
    if not isinstance(found, dict) or found.get("format") != wanted["format"]:
        raise ValueError(f"{path}: expected the journal of a live map ({wanted['format']}), found another file")
    other = [name for name, value in wanted.items() if found.get(name) != value]
    if other:
        raise ValueError(
            f"{path}: expected a map with the same settings, found another {', '.join(other)}; "
            "use the flags and weights of the map, or another --out"
        )
