"""Ways to damage a file that know what is in it. Each says whether its result can still be read as it was meant."""

import json
import re
import struct
from collections.abc import Callable, Mapping
from random import Random
from typing import Any, Literal, NamedTuple

Expected = Literal["refused", "same", "either"]
"""What a reader has to do: refuse, give what the undamaged file gives, or one of the two."""


class Damaged(NamedTuple):
    """A file's content, and what is to come of it."""

    content: bytes
    expected: Expected = "refused"


Damage = Callable[[bytes, Random], Damaged]
"""From a whole file and what draws to a damaged one."""


def flip(content: bytes, draw: Random) -> Damaged:
    """One to three bits."""
    damaged = bytearray(content)
    for _ in range(draw.randint(1, 3)):
        damaged[draw.randrange(len(damaged))] ^= 1 << draw.randrange(8)
    return Damaged(bytes(damaged), "either")


def cut(content: bytes, draw: Random) -> Damaged:
    """The end is missing."""
    return Damaged(content[: draw.randrange(len(content))], "either")


def overwrite(content: bytes, draw: Random) -> Damaged:
    """A stretch of zeros or of noise, as a disk leaves it."""
    at, size = draw.randrange(len(content)), draw.randint(1, 64)
    stretch = bytes(size) if draw.random() < 0.5 else draw.randbytes(size)
    return Damaged((content[:at] + stretch + content[at + size :])[: len(content)], "either")


def repeat(content: bytes, draw: Random) -> Damaged:
    """A part stands there twice."""
    a, b = sorted(draw.randrange(len(content) + 1) for _ in range(2))
    return Damaged(content[:b] + content[a:b] + content[b:], "either")


def other_kind(content: bytes, draw: Random) -> Damaged:
    """A file of another kind under this name."""
    kinds = (
        b"",
        b"\0" * 64,
        b"PK\x03\x04",
        b"\x89PNG\r\n\x1a\n",
        b"{}",
        b"[]",
        b"null",
        b"<html></html>",
        b"\xff\xfe1\0",
    )
    return Damaged(draw.choice((*kinds, draw.randbytes(draw.randint(1, 200)))), "either")


SIZES = (0, 1, 2**16 - 1, 2**24, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**64 - 1, 10**30)
"""Sizes that a header may declare and no file has."""
HEADER = 400
"""Number of bytes at the start of a file, with its header."""


def declare(content: bytes, draw: Random) -> Damaged:
    """A number in the text of a header is another size, or none."""
    numbers = list(re.finditer(rb"[0-9]+", content[:HEADER]))
    if not numbers:
        return extreme(content, draw)
    found = draw.choice(numbers)
    number = draw.choice((*SIZES, -1, "1_0", "x", "", "0x7", "1e9", "９"))
    return Damaged(content[: found.start()] + str(number).encode() + content[found.end() :], "either")


def extreme(content: bytes, draw: Random) -> Damaged:
    """A number of 1 to 8 bytes is another size, in a header or anywhere."""
    size, order = draw.choice((1, 2, 4, 8)), draw.choice(("little", "big"))
    at = draw.randrange(min(len(content), HEADER) if draw.random() < 0.5 else len(content))
    number = (draw.choice(SIZES) % 256**size).to_bytes(size, order)  # pyright: ignore[reportArgumentType]
    return Damaged((content[:at] + number + content[at + size :])[: len(content)], "either")


def flip_header(content: bytes, draw: Random) -> Damaged:
    """One bit of a header: a name, a type or a size."""
    damaged = bytearray(content)
    damaged[draw.randrange(min(len(content), HEADER))] ^= 1 << draw.randrange(8)
    return Damaged(bytes(damaged), "either")


BYTES: Mapping[str, Damage] = {f.__name__: f for f in (flip, cut, overwrite, repeat, other_kind)}
"""What happens to any file."""

WORDS = ("nan", "inf", "-inf", "1e999", "abc", "", "0x1", "1_0", "--1", "1,5", "\x00", "１", "None")
"""What stands in place of a number and is none, or none that is finite."""


def change_word(content: bytes, draw: Random, *, separator: str = " ", skip: int = 0) -> Damaged:
    """One number of a text file is none."""
    lines = content.decode().splitlines()
    row = draw.randrange(skip, len(lines))
    words = lines[row].split(separator)
    words[draw.randrange(len(words))] = draw.choice(WORDS)
    lines[row] = separator.join(words)
    says_nothing = not lines[row].strip()
    return Damaged("\n".join(lines).encode() + b"\n", "either" if says_nothing else "refused")


def drop_word(content: bytes, draw: Random, *, separator: str = " ", skip: int = 0) -> Damaged:
    """One number of a text file is missing, or one too many."""
    lines = content.decode().splitlines()
    row = draw.randrange(skip, len(lines))
    words = lines[row].split(separator)
    at = draw.randrange(len(words))
    words[at : at + 1] = [] if draw.random() < 0.5 else [words[at], "1"]
    lines[row] = separator.join(words)
    return Damaged("\n".join(lines).encode() + b"\n", "refused")


def empty_line(content: bytes, draw: Random) -> Damaged:
    """A line is empty: it may say nothing, but it may not become a row."""
    lines = content.split(b"\n")
    lines.insert(draw.randrange(len(lines)), draw.choice((b"", b"  ", b"\t")))
    return Damaged(b"\n".join(lines), "either")


def windows_lines(content: bytes, draw: Random) -> Damaged:
    """Lines end as on another system: the same file."""
    return Damaged(content.replace(b"\n", b"\r\n"), "same")


WRONG_VALUES = (
    None,
    True,
    -1,
    0.5,
    float("nan"),
    float("inf"),
    1e300,
    10**30,
    "",
    "x",
    "Density",
    [],
    [[]],
    {},
    [1, "a"],
    [None],
)


def json_places(value: Any, place: tuple = ()) -> list[tuple]:
    """Where there is a value in JSON: the names and numbers that lead to each."""
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [place, *(deeper for key, one in inner for deeper in json_places(one, (*place, key)))]


def change_json(value: Any, draw: Random) -> Any:
    """The same JSON with one place changed, dropped or added to."""
    value = json.loads(json.dumps(value))
    places = [place for place in json_places(value) if place]
    *way, last = draw.choice(places)
    parent = value
    for key in way:
        parent = parent[key]
    action = draw.choice(("change", "change", "drop", "add"))
    if action == "change" or isinstance(parent, list):
        parent[last] = draw.choice(WRONG_VALUES)
    elif action == "drop":
        del parent[last]
    else:
        parent[f"{last}_"] = parent[last]
    return value


def safetensors_parts(content: bytes) -> tuple[dict[str, Any], bytes]:
    """The header of a safetensors file and its numbers."""
    (size,) = struct.unpack("<Q", content[:8])
    return json.loads(content[8 : 8 + size]), content[8 + size :]


def safetensors_file(header: Any, body: bytes) -> bytes:
    """The inverse of `safetensors_parts`."""
    text = json.dumps(header).encode()
    return struct.pack("<Q", len(text)) + text + body
