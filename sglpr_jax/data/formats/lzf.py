"""LZF decompression, for binary_compressed .pcd files. LZF data consists of literal runs and back references."""


def decompress_lzf(data: bytes, *, size: int) -> bytes:
    """Return the decompressed data.

    Arguments:
      data: Compressed data.
      size: Expected number of decompressed bytes.

    Raises:
      ValueError: If `data` is truncated, malformed or of another size.
    """
    out = bytearray()
    at, end = 0, len(data)
    try:
        while at < end:
            control = data[at]
            at += 1
            if control < 32:  # a literal run of control + 1 bytes
                out += data[at : at + control + 1]
                at += control + 1
                continue
            length = control >> 5
            if length == 7:
                length += data[at]
                at += 1
            start = len(out) - ((control & 31) << 8) - data[at] - 1
            at += 1
            if start < 0:
                raise ValueError("expected LZF, found a reference to before the start")
            _copy(out, start, length + 2)
            if len(out) > size:
                break
    except IndexError as error:
        raise ValueError("expected LZF, found truncated data") from error
    if len(out) != size or at != end:
        raise ValueError(f"expected {size} decompressed bytes, found {len(out)}")
    return bytes(out)


def _copy(out: bytearray, start: int, length: int) -> None:
    """Append `length` bytes from `start`. The range may overlap the appended bytes."""
    whole = out[start : start + length]
    while len(whole) < length:
        whole += whole[: length - len(whole)]
    out += whole
