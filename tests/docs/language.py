"""The sentences of pages and docstrings, and what is wrong with their English."""

import ast
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

MEAN_WORDS, MOST_WORDS = 16.0, 35
"""Maximum number of words of a sentence: mean over a file, and each."""
VAGUE = (
    "are none",
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
    "refused",
    "refuses",
    "so many",
    "that which",
    "throw-away",
    "told",
)
"""Words that stand where a noun or a plain verb should."""


def sentences_of_page(page: Path) -> Iterator[str]:
    """Sentences of the running text. Headings, code, tables and HTML are left out; a link is its text."""
    text = re.sub(r"^(```|~~~).*?^\1", "\n", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    text = re.sub(r"<[^>]+>|!\[[^\]]*\]\([^)]*\)", " ", text)
    text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", text)
    for block in re.split(r"\n\s*\n|\n(?=\s*(?:[*-]|\d+\.) )|\n(?=[#|!])", text):
        line = " ".join(block.split())
        if line and line[0] not in "#|!":
            yield from _split(re.sub(r"^(?:[*-]|\d+\.) ", "", line))


def sentences_of_code(path: Path) -> Iterator[str]:
    """Sentences of the docstrings of a file, without their examples."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            text = node.value.value.partition("Example:")[0]
            for block in re.split(r"\n\s*\n|\n(?=\s*(?:[*-]|[\w*]+:) )", text):
                yield from _split(" ".join(block.split()))


def _split(line: str) -> Iterator[str]:
    line = re.sub(r"`[^`]*`", "CODE", line)
    yield from filter(None, (part.strip() for part in re.split(r"(?<=[.!?])[\"*)]*\s+(?=[\"*(A-Z0-9])", line)))


def length(sentence: str) -> int:
    """Number of words, without numbers and punctuation."""
    return len(re.findall(r"[A-Za-z][\w'-]*", sentence))


def faults(sentences: Iterable[str]) -> list[str]:
    """What breaks the rules, a line each."""
    found = list(sentences)
    faults = [f"{length(one)} words: {one}" for one in found if length(one) > MOST_WORDS]
    faults += [
        f'"{word}": {one}'
        for one in found
        for word in VAGUE
        if re.search(rf"\b{re.escape(word)}\b", one.replace("None", "CODE"), re.IGNORECASE)
    ]
    mean = sum(map(length, found)) / max(len(found), 1)
    return [*faults, *([f"mean length {mean:.1f} words"] if mean > MEAN_WORDS else [])]
