"""Lists folders for the readers of datasets: scan files in natural order, and names of sequences."""

import re
from collections import Counter
from collections.abc import Iterable
from decimal import Decimal
from pathlib import Path

_DECIMAL = re.compile(r"(?P<prefix>(?:.*[^\d.])?)(?P<number>\d+\.(?:\d*[1-9]|0))(\.[A-Za-z]\w*)*$")
"""File name that ends with a decimal number without trailing zeros, such as a timestamp, and its extensions:
scan_1561000444.39.bin. Others are sorted right by their natural order."""


def files_in(folder: Path, *endings: str) -> tuple[Path, ...]:
    """Return the files of a folder with one of the lower-case `endings`, in natural order. The files may be upper-case.

    Hidden files are skipped: macOS writes a `._000003.bin` beside each scan that it copies.
    """
    if not folder.is_dir():
        return ()
    visible = (path for path in folder.iterdir() if not path.name.startswith("."))
    return in_natural_order(path for path in visible if path.name.lower().endswith(endings))


def scans_in(folder: Path, *endings: str, kind: str = "scans") -> tuple[Path, ...]:
    """Return the files of a folder with one of the `endings`. Raises FileNotFoundError if the folder has none."""
    paths = files_in(folder, *endings)
    if not paths:
        expected = ", ".join(f"*{ending}" for ending in endings)
        raise FileNotFoundError(f"{folder}: expected {kind} ({expected}), found none")
    return paths


def names_of(root: Path, *, pattern: str) -> tuple[str, ...]:
    """Return the sorted names that the first wildcard of a pattern matches: 00, 01, ... for "sequences/*/velodyne/"."""
    wildcard_level = next(level for level, part in enumerate(Path(pattern).parts) if "*" in part or "[" in part)
    return tuple(sorted({path.relative_to(root).parts[wildcard_level] for path in root.glob(pattern)}))


def in_natural_order(paths: Iterable[Path]) -> tuple[Path, ...]:
    """Sort paths by name, with numbers compared as numbers: full2 before full10.

    If all names are decimal numbers after the same prefix, such as timestamps, the numbers are compared as decimals:
    scan_1.25 before scan_1.5.
    """
    files = list(paths)
    decimals = {path: match for path in files if (match := _DECIMAL.match(path.name))}
    if len(decimals) == len(files) and len({match["prefix"] for match in decimals.values()}) == 1:
        return tuple(sorted(files, key=lambda path: (Decimal(decimals[path]["number"]), path.name)))
    return tuple(sorted(files, key=lambda path: _natural_key(path.name)))


def describe_contents(folder: Path, *, without: Iterable[Path] = ()) -> str:
    """Return a summary of a folder, such as "2 .txt, 1 folder (images)", without some paths and hidden files."""
    excluded = set(without)
    paths = [path for path in folder.iterdir() if path not in excluded and not path.name.startswith(".")]
    folders = in_natural_order(path for path in paths if path.is_dir())
    endings = Counter(path.suffix or path.name for path in paths if not path.is_dir())
    contents = [f"{count} {ending}" for ending, count in sorted(endings.items())]
    if folders:
        names = ", ".join(path.name for path in folders[:3]) + (", ..." if len(folders) > 3 else "")
        contents.append(f"{len(folders)} {'folder' if len(folders) == 1 else 'folders'} ({names})")
    return ", ".join(contents)


def _natural_key(name: str) -> tuple[tuple[int, int, int, str], ...]:
    """Return a sort key of the parts of a name: numbers before text, and equal numbers by their number of digits."""
    parts = re.findall(r"\d+|\D+", name)
    return tuple((0, int(part), len(part), "") if part.isdecimal() else (1, 0, 0, part) for part in parts)
