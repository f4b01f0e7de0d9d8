"""The pages of the manual and the README, and their blocks of code."""

import re
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]
_NAMES = ("api", "commands", "configuration", "labels", "licences")
GENERATED = {ROOT / "docs" / "reference" / f"{name}.md" for name in _NAMES}
PAGES = [ROOT / "README.md", *sorted(set((ROOT / "docs").rglob("*.md")) - GENERATED)]


class Block(NamedTuple):
    """A block of code: its language, its lines as one text, and the line of the page that it begins after."""

    language: str
    text: str
    line: int


def name_of(page: Path) -> str:
    """A page as a test names it: "docs/index.md"."""
    return str(page.relative_to(ROOT))


def blocks(page: Path) -> list[Block]:
    """All fenced blocks of a page, in order."""
    text = page.read_text()
    return [
        Block(found[1], found[2], text.count("\n", 0, found.start()) + 1)
        for found in re.finditer(r"^```(\w*)\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    ]


def command_lines(block: Block) -> list[str]:
    """The commands of a bash block, one each: loops, chains, comments and continued lines are taken apart."""
    lines = block.text.replace("\\\n", " ").splitlines()
    code = "\n".join(re.split(r"(?:^|\s)#\s", line)[0] for line in lines)
    code = re.sub(r"(^|;)\s*(do\b|taskset -c \d+)", r"\1", code, flags=re.MULTILINE)
    return [command.strip() for command in re.split(r";|&&|\n", code) if command.strip()]
