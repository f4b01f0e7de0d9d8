"""Reads numbers from the text of scan files and of their headers.

Python's `int` and `float` also accept `1_0` and digits of other alphabets. The functions here reject both.
"""

import re
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from sglpr_jax.files import in_short

_NOT_A_NUMBER = re.compile(rb"[-+]?(?:nan\([^\s()]*\)|1\.#(?:ind|[qs]?nan)\w*)", re.IGNORECASE)
"""Spellings of NaN by the C libraries of Windows and Linux: `-nan(ind)`, `nan(0x1)`, `1.#QNAN`."""


def whole_number(word: str, *, of: str) -> int:
    """Return a number of at most 18 decimal digits. Raises ValueError for other words. The message names `of`."""
    if not re.fullmatch("[0-9]{1,18}", word):
        raise ValueError(f"expected a whole number as {of}, found {word[:40]!r}")
    return int(word)


def text_lines(body: bytes) -> list[bytes]:
    """Return the lines that are not blank."""
    return [line for line in body.splitlines() if line.strip()]


def number_rows(lines: Sequence[bytes], *, rows: int, columns: int) -> Float64[np.ndarray, "{rows} {columns}"]:
    """Return the numbers of text lines, NaN and infinity included. Numbers are separated by white space.

    Raises:
      ValueError: If there are other than `rows` lines, or a line does not have `columns` numbers.
    """
    expected = f"expected {rows} lines of {columns} numbers"
    if len(lines) != rows:
        raise ValueError(f"{expected}, found {len(lines)} lines")
    words = (_NOT_A_NUMBER.sub(b"nan", line).decode("ascii", errors="replace") for line in lines)
    try:
        found = np.loadtxt(words, np.float64, comments=None, ndmin=2)
    except ValueError as error:
        raise ValueError(f"{expected}, found others ({in_short(error)})") from error
    if found.shape != (rows, columns):
        raise ValueError(f"{expected}, found {found.shape[0]} lines of {found.shape[1]}")
    return found
