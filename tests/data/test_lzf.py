"""LZF, against a compressor of our own: literals, copies, and copies that overlap what they write."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sglpr_jax.data.formats.pcd import decompress_lzf


def compress(data: bytes) -> bytes:
    """LZF of `data`: at each place the longest copy among the last few hundred bytes, else a literal."""
    out, literals, at = bytearray(), bytearray(), 0

    def flush():
        for start in range(0, len(literals), 32):
            run = literals[start : start + 32]
            out.extend(bytes([len(run) - 1]) + run)
        literals.clear()

    while at < len(data):
        length, offset = 0, 0
        for back in range(1, min(at, 400) + 1):
            n = 0
            while n < 264 and at + n < len(data) and data[at - back + n] == data[at + n]:
                n += 1
            if n > length:
                length, offset = n, back - 1
        if length < 3:
            literals.append(data[at])
            at += 1
            continue
        flush()
        short = length - 2
        out.append((min(short, 7) << 5) | offset >> 8)
        if short >= 7:
            out.append(short - 7)
        out.append(offset & 255)
        at += length
    flush()
    return bytes(out)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.sampled_from([b"a", b"ab", b"xyz", bytes(40), b"\x00\x01\x02"]), max_size=60).map(b"".join))
def test_what_was_compressed_comes_back(data):
    assert decompress_lzf(compress(data), size=len(data)) == data


def test_long_literals_and_long_copies():
    noise = np.random.default_rng(0).bytes(1000)
    for data in (noise, b"q" * 5000, noise + noise[:300] + b"z" * 99):
        packed = compress(data)
        assert decompress_lzf(packed, size=len(data)) == data
    assert len(compress(b"q" * 5000)) < 100


@pytest.mark.parametrize(
    ("data", "size"),
    [(b"\x05abc", 6), (b"\xe0", 9), (b"\x20", 3), (b"\x20\x00", 3), (b"\x00a", 2), (b"\x00a\x00b", 1), (b"", 1)],
    ids=["cut literal", "no length", "no offset", "before the beginning", "too short", "too long", "nothing"],
)
def test_broken_data_is_refused(data, size):
    with pytest.raises(ValueError, match="expected"):
        decompress_lzf(data, size=size)
