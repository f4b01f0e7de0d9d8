"""Names from datasets and files: as file names, as paths inside a dataset, and as text to print."""

import hashlib
import os
import re
from pathlib import Path
from typing import Any

MOST_BYTES = 120
"""Maximum length of a file name from `file_name`, in bytes. Suffixes and temporary files need the rest of the usual
255."""
MOST_SHOWN = 100
"""Maximum number of printed characters of a name."""
_UNSAFE = re.compile(r"[/\\\x00-\x1f\x7f]")


def file_name(name: str) -> str:
    """Return the name of the file or folder for a recording or a scan with this name.

    A name that is a safe file name stays unchanged. In any other name, such as `../x` or a very long name, unusual
    characters are replaced and a hash is appended. Different names have different file names.
    """
    try:
        size = len(os.fsencode(name))
    except UnicodeEncodeError:  # half of a surrogate pair, as JSON may contain
        size = 0
    if 0 < size <= MOST_BYTES and name not in (".", "..") and not _UNSAFE.search(name):
        return name
    readable = re.sub(r"[^\w.-]", "_", name, flags=re.ASCII)[: MOST_BYTES // 2].strip(".")
    return f"{readable}-{hashlib.sha256(name.encode(errors='surrogatepass')).hexdigest()[:16]}"


def path_inside(root: Path, listed: Any, *, source: Path) -> Path:
    """Return the path of a file that a table lists relative to the folder of its dataset.

    Raises ValueError, which names the table `source`, if `listed` is not a relative path or leads out of `root`.
    """
    path = Path(listed) if isinstance(listed, str) and "\0" not in listed else Path("..")
    if path.anchor or ".." in path.parts or path == Path():
        raise ValueError(f"{source}: expected paths of files inside {root}, found {listed!r:.80}")
    return root / path


def printable(name: str, *, most: int = MOST_SHOWN) -> str:
    """Return a name as one line of printable text. Other characters are escaped. A long name loses its middle."""
    shown = name if len(name) <= most else f"{name[: most - 19]}...{name[-16:]}"
    return "".join(one if one.isprintable() else one.encode("unicode_escape").decode() for one in shown)
