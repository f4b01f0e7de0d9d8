"""Damage of files and messages, as a disk, a network or another program makes it, and what reading does then."""

import re
import tempfile
from pathlib import Path
from typing import Any

from hypothesis import strategies as st

from .formats import Format

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


def read(format: Format, content: bytes) -> Any:
    """Read a file in a folder with nothing but the files that must lie beside it."""
    with tempfile.TemporaryDirectory() as folder:
        for name, one in {**format.beside, format.file: content}.items():
            path = Path(folder) / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(one)
        before = sorted(Path(folder).rglob("*"))
        try:
            return format.read(Path(folder) / format.file)
        finally:
            assert sorted(Path(folder).rglob("*")) == before, "reading wrote a file"


def refused(format: Format, content: bytes) -> bool:
    """Read a damaged file. Returns whether it is refused; any other error than a good one fails the test."""
    try:
        read(format, content)
    except (ValueError, OSError) as error:
        line, named = str(error), {Path(name).name for name in (*format.beside, format.file)}
        named |= {Path(name).parts[0] for name in format.beside}
        assert any(name in line for name in (*named, tempfile.gettempdir())), line
        assert "expected" in line and "found" in line and "\n" not in line and len(line) < 1500, line
        return True
    return False
