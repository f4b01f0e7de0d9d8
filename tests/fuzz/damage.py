"""Damage of files and messages, as a disk, a network or another program makes it."""

import re

from hypothesis import strategies as st

SIZES = (0, 1, 2**16 - 1, 2**24, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**64 - 1, 10**30)
"""Sizes that a header may declare and no file has."""
STRANGE = (*map(str, SIZES), "-1", "1_0", "x", "", "0x7", "1e300", "nan", "９")
OTHER_KINDS = (b"", bytes(64), b"PK\x03\x04", b"\x89PNG\r\n\x1a\n", b"{}", b"[]", b"null", b"[" * 9999, b"\xff\xfe1\0")


@st.composite
def damaged(draw: st.DrawFn, whole: bytes) -> bytes:
    """A file that is cut, has other or more bytes at one place, declares another size, or is of another kind."""
    at = draw(st.integers(0, len(whole) - 1) | st.integers(0, min(len(whole), 400) - 1))
    match draw(st.sampled_from(("cut", "bytes", "more", "number", "size", "other"))):
        case "cut":
            return whole[:at]
        case "bytes":
            new = draw(st.binary(min_size=1, max_size=8))
            return (whole[:at] + new + whole[at + len(new) :])[: len(whole)]
        case "more":
            return whole[:at] + draw(st.binary(min_size=1, max_size=64)) + whole[at:]
        case "number" if numbers := list(re.finditer(rb"[0-9]+", whole)):
            number = draw(st.sampled_from(numbers))
            return whole[: number.start()] + draw(st.sampled_from(STRANGE)).encode() + whole[number.end() :]
        case "other":
            return draw(st.sampled_from(OTHER_KINDS))
        case _:
            width, order = draw(st.sampled_from((1, 2, 4, 8))), draw(st.sampled_from(("little", "big")))
            number = (draw(st.sampled_from(SIZES)) % 256**width).to_bytes(width, order)
            return (whole[:at] + number + whole[at + width :])[: len(whole)]
