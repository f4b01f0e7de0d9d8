"""Reader of text files with one item per line. Empty lines and lines that start with # are ignored."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int


def read_lines(path: Path) -> Iterator[tuple[str, str]]:
    """Yield location (for error messages) and text of every line that is not empty or a comment."""
    for number, line in enumerate(path.read_text(errors="replace").splitlines(), start=1):
        if line.strip() and not line.startswith("#"):
            yield f"{path}, line {number}", line


def as_frame(word: str, where: str) -> int:
    """Return a frame number. Raises ValueError, with a message that begins with `where`, for other words."""
    if not (word.isascii() and word.isdigit() and len(word) < 10):
        raise ValueError(f"{where}: expected a frame number, found {word!r}")
    return int(word)


def as_score(word: str, where: str) -> float:
    """Return a finite number. Raises ValueError, with a message that begins with `where`, for other words."""
    try:
        score = float(word if word.isascii() and "_" not in word else "")  # Python reads 1_0 as 10
    except ValueError as error:
        raise ValueError(f"{where}: expected a score, found {word!r}") from error
    if not np.isfinite(score):
        raise ValueError(f"{where}: expected a finite score, found {word!r}")
    return score


def check_rows(where: list[str], frames: Int[np.ndarray, "rows _"], n: int, source: str) -> None:
    """Raise ValueError if a frame is not among the n frames of `source`. The message names the first such line."""
    outside = np.argwhere(frames >= n)
    if outside.size:
        row, column = outside[0]
        raise ValueError(f"{where[row]}: expected frames from 0 to {n - 1} ({source}), found {frames[row, column]}")


def padded(rows: Sequence[Sequence[int | float]], fill: int | float) -> Float[np.ndarray, "rows columns"]:
    """Return rows of different lengths as one array with at least one column, padded with `fill`."""
    columns = max([1, *map(len, rows)])
    return np.array([[*row, *[fill] * (columns - len(row))] for row in rows], dtype=np.float64)
