"""Lists the recordings of a folder, and its scan files in natural order."""

import re
from collections import Counter
from collections.abc import Iterable
from decimal import Decimal
from pathlib import Path

_DECIMAL = re.compile(r"(\d+\.\d+)(\.[A-Za-z]\w*)*$")
"""File name that is a decimal number, such as a timestamp, followed by its extensions."""


def files_in(folder: Path, *endings: str) -> tuple[Path, ...]:
    """Return the files of a folder with one of some extensions in lower case, in natural order. Case is ignored.

    Hidden files are skipped: macOS writes a `._000003.bin` beside each scan that it copies.
    """
    if not folder.is_dir():
        return ()
    return in_order(
        path for path in folder.iterdir() if path.name.lower().endswith(endings) and not path.name.startswith(".")
    )


def scans_in(folder: Path, *endings: str, kind: str = "scans") -> tuple[Path, ...]:
    """Return the files of a folder like `files_in`. Raises FileNotFoundError if the folder has no such file."""
    paths = files_in(folder, *endings)
    if not paths:
        expected = ", ".join(f"*{ending}" for ending in endings)
        raise FileNotFoundError(f"{folder}: expected {kind} ({expected}), found none")
    return paths


def names_of(root: Path, *, pattern: str) -> tuple[str, ...]:
    """Return the names of the folders in `root` that a pattern such as "sequences/*/velodyne/" finds, in order."""
    at = next(i for i, part in enumerate(Path(pattern).parts) if "*" in part or "[" in part)
    return tuple(sorted({path.relative_to(root).parts[at] for path in root.glob(pattern)}))


def in_order(paths: Iterable[Path]) -> tuple[Path, ...]:
    """Sort paths by name, with numbers compared as numbers: full2 before full10.

    If all names are decimal numbers, such as timestamps, they are compared as decimals: 1.25 before 1.5.
    """
    files = list(paths)
    times = {path: time[1] for path in files if (time := _DECIMAL.match(path.name))}
    if len(times) == len(files):
        return tuple(sorted(files, key=lambda path: (Decimal(times[path]), path.name)))
    return tuple(sorted(files, key=lambda path: _natural(path.name)))


def other_contents(folder: Path, taken: Iterable[Path]) -> str:
    """Return a summary of the other contents of a folder: numbers of files by extension, and subfolders."""
    known = set(taken)
    others = [path for path in folder.iterdir() if path not in known and not path.name.startswith(".")]
    folders = in_order(path for path in others if path.is_dir())
    endings = Counter(path.suffix or path.name for path in others if not path.is_dir())
    contents = [f"{count} {ending}" for ending, count in sorted(endings.items())]
    if folders:
        names = ", ".join(path.name for path in folders[:3]) + (", ..." if len(folders) > 3 else "")
        contents.append(f"{len(folders)} {'folder' if len(folders) == 1 else 'folders'} ({names})")
    return ", ".join(contents)


def _natural(name: str) -> tuple[tuple[int, int, int, str], ...]:
    """Sort key: the parts of a name, numbers before text, and equal numbers by their number of digits."""
    parts = re.findall(r"\d+|\D+", name)
    return tuple((0, int(part), len(part), "") if part.isdecimal() else (1, 0, 0, part) for part in parts)
