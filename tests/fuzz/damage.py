"""Damage of files and messages, as a disk, a network or another program makes it, and what reading does then."""

import re
import tempfile
from pathlib import Path
from random import Random
from typing import Any

from hypothesis import strategies as st

from .formats import Format

SIZES = (0, 1, 2**16 - 1, 2**24, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**64 - 1, 10**30)
"""Sizes that a header may declare and no file has."""
STRANGE = (*map(str, SIZES), "-1", "1_0", "x", "", "0x7", "1e300", "nan", "９")
OTHER_KINDS = (b"", bytes(64), b"PK\x03\x04", b"\x89PNG\r\n\x1a\n", b"{}", b"[]", b"null", b"[" * 9999, b"\xff\xfe1\0")


def damage(whole: bytes, chance: Random) -> bytes:
    """A file that is cut, has other or more bytes at one place, declares another size, or is of another kind."""
    at = chance.randrange(chance.choice((len(whole), min(len(whole), 400))))
    match chance.choice(("cut", "bytes", "more", "number", "size", "other")):
        case "cut":
            return whole[:at]
        case "bytes":
            new = chance.randbytes(chance.randint(1, 8))
            return (whole[:at] + new + whole[at + len(new) :])[: len(whole)]
        case "more":
            return whole[:at] + chance.randbytes(chance.randint(1, 64)) + whole[at:]
        case "number" if numbers := list(re.finditer(rb"[0-9]+", whole)):
            number = chance.choice(numbers)
            return whole[: number.start()] + chance.choice(STRANGE).encode() + whole[number.end() :]
        case "other":
            return chance.choice(OTHER_KINDS)
        case _:
            width, order = chance.choice((1, 2, 4, 8)), chance.choice(("little", "big"))
            number = (chance.choice(SIZES) % 256**width).to_bytes(width, order)
            return (whole[:at] + number + whole[at + width :])[: len(whole)]


def damaged(whole: bytes) -> st.SearchStrategy[bytes]:
    """Files with `damage`."""
    return st.builds(damage, st.just(whole), st.randoms(use_true_random=False))


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
