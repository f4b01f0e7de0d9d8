"""Which files of a folder are its scans, in the order of their numbers."""

import re
from collections import Counter
from collections.abc import Iterable
from decimal import Decimal
from pathlib import Path

_DECIMAL = re.compile(r"(\d+\.\d+)(\.[A-Za-z]\w*)*$")
"""The name of a file that is called by its time, with its endings."""


def files_in(folder: Path, *endings: str) -> tuple[Path, ...]:
    """Return the files of `folder` with one of these endings, small or in capitals, in natural order.

    None where there is no such folder.

    Hidden files are none: a Mac leaves `._000003.bin` beside each scan that it copies.
    """
    if not folder.is_dir():
        return ()
    return in_order(path for path in folder.iterdir() if path.name.lower().endswith(endings) and not hidden(path))


def in_order(paths: Iterable[Path]) -> tuple[Path, ...]:
    """Return paths by name, numbers in the names as numbers: full2 before full10.

    Where all names are decimal numbers, as of scans that are called by their times, 1.25 is before 1.5.
    """
    found = list(paths)
    times = {path: time[1] for path in found if (time := _DECIMAL.match(path.name))}
    if len(times) == len(found):
        return tuple(sorted(found, key=lambda path: (Decimal(times[path]), path.name)))
    return tuple(sorted(found, key=lambda path: _natural(path.name)))


def hidden(path: Path) -> bool:
    """Whether the name begins with a dot."""
    return path.name.startswith(".")


def left_aside(folder: Path, taken: Iterable[Path]) -> str:
    """Return in words what else is in a folder: its subfolders, and other files by their endings; "" for nothing."""
    known = set(taken)
    others = [path for path in folder.iterdir() if path not in known and not hidden(path)]
    folders = in_order(path for path in others if path.is_dir())
    endings = Counter(path.suffix or path.name for path in others if not path.is_dir())
    said = [f"{count} {ending}" for ending, count in sorted(endings.items())]
    if folders:
        named = ", ".join(path.name for path in folders[:3]) + (", ..." if len(folders) > 3 else "")
        said.append(f"{len(folders)} {'folder' if len(folders) == 1 else 'folders'} ({named})")
    return ", ".join(said)


def _natural(name: str) -> tuple[tuple[int, int, int, str], ...]:
    """A sorting key: the name in parts, numbers before text, equal numbers by how many digits they have."""
    parts = re.findall(r"\d+|\D+", name)
    return tuple((0, int(part), len(part), "") if part.isdecimal() else (1, 0, 0, part) for part in parts)
