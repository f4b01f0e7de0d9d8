"""Bounds what the compressed parts of a bag inflate to. A few kilobytes may declare or hold any number of bytes."""

import bz2
import functools
import os
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

MOST_BYTES = 2**28
"""Maximum size of a chunk or a message: 256 MiB. Recorders write chunks of 4 MiB, or of a single larger message."""

INFLATION = 64
"""Maximum size of an inflated file, as a multiple of its compressed size, if it is larger than `MOST_BYTES`."""


@functools.cache
def bound_bags() -> None:
    """Make rosbags inflate at most `MOST_BYTES` at a time. Its own functions inflate all that they are given."""
    from lz4.frame import LZ4FrameDecompressor
    from rosbags.rosbag1 import reader as rosbag1
    from rosbags.rosbag2 import reader as rosbag2
    from rosbags.rosbag2 import storage_mcap

    zstd: Any = vars(storage_mcap)["zstd"]
    rosbag1.decompressors.update(
        bz2=functools.partial(inflated, bz2.BZ2Decompressor), lz4=functools.partial(inflated, LZ4FrameDecompressor)
    )
    storage_mcap.DECOMPRESSORS.update(
        lz4=functools.partial(_declared, LZ4FrameDecompressor), zstd=functools.partial(_declared, zstd.ZstdDecompressor)
    )
    bounded = {"decompress": functools.partial(inflated, zstd.ZstdDecompressor), "open": _bounded_file(zstd)}
    rosbag2.__dict__["zstd"] = SimpleNamespace(**{**vars(zstd), **bounded})


def _bounded_file(zstd: Any) -> type:
    """Class of an open zstd file that inflates to at most `INFLATION` times its size, or `MOST_BYTES`."""

    class BoundedFile(zstd.ZstdFile):
        def __init__(self, file: Any, mode: str):
            super().__init__(file, mode)
            self._left = max(MOST_BYTES, INFLATION * os.fstat(file.fileno()).st_size)

        def read(self, size: int | None = -1, /) -> bytes:
            part = super().read(size)
            self._left -= len(part)
            if self._left < 0:
                raise ValueError(f"expected at most {INFLATION} times the size of a compressed file, found more")
            return part

    return BoundedFile


def inflated(decompressor: Callable[[], Any], content: bytes, *, most: int | None = None) -> bytes:
    """Inflate a chunk or a message of one frame or several.

    Arguments:
      decompressor: Makes a decompressor for a frame.
      content: Compressed bytes.
      most: Maximum number of bytes, by default `MOST_BYTES`.

    Raises ValueError if the frames hold more bytes, or if the last one is cut. Decompressors raise many types of errors
    for damaged frames.
    """
    most, parts = MOST_BYTES if most is None else most, []
    while content or not parts:
        one = decompressor()
        parts.append(one.decompress(content, max_length=most + 1 - sum(map(len, parts))))
        if sum(map(len, parts)) > most:
            raise ValueError(f"expected at most {most} bytes in a compressed part, found more")
        if not one.eof:
            raise ValueError("expected a whole compressed part, found one that is cut")
        content = one.unused_data or b""
    return b"".join(parts)


def _declared(decompressor: Callable[[], Any], content: bytes, size: int) -> bytes:
    """Inflate a chunk of a declared size."""
    if size > MOST_BYTES:
        raise ValueError(f"expected a chunk of at most {MOST_BYTES} bytes, found {size} declared")
    return inflated(decompressor, content, most=size)
