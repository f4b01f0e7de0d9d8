"""The sentences of a page, and what is wrong with their English."""

import re
from collections.abc import Iterator
from pathlib import Path

MEAN_WORDS, MOST_WORDS = 16.0, 35
"""Limits of the length of a sentence: over a page, and each."""
VAGUE = (
    "as it is",
    "goes around",
    "hand in",
    "handed in",
    "is none",
    "none of such",
    "of no such",
    "of such",
    "of those",
    "of which",
    "said",
    "so far as",
    "so many",
    "that which",
    "throw-away",
    "told",
)
"""Words that stand where a noun or a plain verb should."""


def sentences(page: Path) -> Iterator[str]:
    """Sentences of the running text: headings, code, tables and HTML are left out; a link is its text."""
    text = re.sub(r"^(```|~~~).*?^\1", "\n", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    text = re.sub(r"<[^>]+>|!\[[^\]]*\]\([^)]*\)", " ", text)
    text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", text)
    for block in re.split(r"\n\s*\n|\n(?=\s*(?:[*-]|\d+\.) )|\n(?=[#|!])", text):
        line = " ".join(block.split())
        if line and line[0] not in "#|!":
            yield from _split(re.sub(r"^(?:[*-]|\d+\.) ", "", line))


def _split(line: str) -> Iterator[str]:
    line = re.sub(r"`[^`]*`", "CODE", line)
    yield from filter(None, (part.strip() for part in re.split(r"(?<=[.!?])[\"*)]*\s+(?=[\"*(A-Z0-9])", line)))


def length(sentence: str) -> int:
    """Number of words; code, numbers and punctuation between them are one word each at most."""
    return len(re.findall(r"[A-Za-z][\w'-]*", sentence))


def faults(page: Path) -> list[str]:
    """What breaks the rules on a page, a line each."""
    found = list(sentences(page))
    faults = [f"{length(one)} words: {one}" for one in found if length(one) > MOST_WORDS]
    faults += [
        f'"{word}": {one}'
        for one in found
        for word in VAGUE
        if re.search(rf"\b{re.escape(word)}\b", one, re.IGNORECASE)
    ]
    mean = sum(map(length, found)) / max(len(found), 1)
    return [*faults, *([f"mean length {mean:.1f} words"] if mean > MEAN_WORDS else [])]
