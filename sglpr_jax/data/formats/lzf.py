"""The compression of binary_compressed .pcd files: LZF, literal runs and copies of what came before."""


def decompress_lzf(data: bytes, *, size: int) -> bytes:
    """Return `size` decompressed bytes; ValueError where `data` is cut off, broken or of another size."""
    out = bytearray()
    at, end = 0, len(data)
    try:
        while at < end:
            control = data[at]
            at += 1
            if control < 32:  # so many bytes and one more, as they are
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
                raise ValueError("expected LZF, found a copy from before the beginning")
            _copy(out, start, length + 2)
            if len(out) > size:
                break
    except IndexError as error:
        raise ValueError("expected LZF, found its end too early") from error
    if len(out) != size or at != end:
        raise ValueError(f"expected {size} decompressed bytes, found {len(out)}")
    return bytes(out)


def _copy(out: bytearray, start: int, length: int) -> None:
    """Append `length` bytes from `start`; they may reach into what is being appended."""
    whole = out[start : start + length]
    while len(whole) < length:
        whole += whole[: length - len(whole)]
    out += whole
