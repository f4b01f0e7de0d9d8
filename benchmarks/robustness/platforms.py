"""Whether PyPI has wheels of every dependency, for each platform and Python: a Markdown table, and what is missing.

    python -m benchmarks.robustness.platforms
    python -m benchmarks.robustness.platforms --extras slam live --pythons 3.12

Each extra of pyproject.toml is resolved with all that it needs, from wheels only. Nothing is installed. The program is
`uv pip compile` (pip install uv): unlike pip, it applies the conditions of the other platform.
"""

import argparse
import datetime
import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]
PLATFORMS = {
    "Linux x86_64": "x86_64-manylinux_2_28",
    "Linux aarch64": "aarch64-manylinux_2_28",
    "macOS arm64": "aarch64-apple-darwin",
    "macOS x86_64": "x86_64-apple-darwin",
    "Windows amd64": "x86_64-pc-windows-msvc",
}
"""Names of platforms, with uv's name of each."""
PYTHONS = ("3.11", "3.12", "3.13")
REQUIRED = "required"
AT_ONCE = 8
"""Number of programs that run at a time. They wait for the network most of the time."""
NOT_OF_USERS = ("dev",)
"""Extras of those who work on the library itself."""
UNAVAILABLE = re.compile(r"\b([A-Za-z][\w.-]*?)(?:[<>=!]\S*)? (?:has|have) no (?:usable )?wheels")
MACOS = "14.0"
"""Version of macOS. By default uv takes 13.0, for which small-gicp has no wheel."""


class Missing(NamedTuple):
    """A requirement without a wheel."""

    platform: str
    python: str
    extra: str
    name: str
    reason: str


def main() -> None:
    """Parse the command line, and print the table and what is missing."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pythons", nargs="*", default=PYTHONS)
    parser.add_argument("--platforms", nargs="*", default=list(PLATFORMS), choices=PLATFORMS)
    parser.add_argument("--extras", nargs="*", help="default: all, and what is required")
    options = parser.parse_args()
    if shutil.which("uv") is None:
        sys.exit("expected the program uv, found none; pip install uv")
    wanted = {name: needs for name, needs in requirements() if options.extras is None or name in options.extras}
    asked = [
        (*one, platform, python)
        for one in wanted.items()
        for platform in options.platforms
        for python in options.pythons
    ]
    with ThreadPoolExecutor(AT_ONCE) as pool:
        missing = [one for found in pool.map(lambda one: absent(*one), asked) for one in found]
    print(f"{datetime.date.today()}, Python {', '.join(options.pythons)}\n")
    print(table(list(wanted), missing, options), end="\n\n")
    print("\n".join(f"{platform}, {name}: {reason}" for platform, name, reason in reasons(missing)))


def requirements() -> Iterator[tuple[str, list[str]]]:
    """What is required and each extra of users, with their requirements."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    yield REQUIRED, project["dependencies"]
    yield from ((name, needs) for name, needs in project["optional-dependencies"].items() if name not in NOT_OF_USERS)


def absent(extra: str, needs: list[str], platform: str, python: str) -> list[Missing]:
    """Requirements that cannot be resolved. All are tried together first, and singly if that fails."""
    together = reason_against(needs, platform, python)
    if not together:
        return []
    reasons = (
        {need: reason_against([need], platform, python) for need in needs} if len(needs) > 1 else {needs[0]: together}
    )
    found = {re.split(r"[\[<>=!; ]", need)[0]: reason for need, reason in reasons.items() if reason}
    found = found or {" with ".join(needs): "their needs contradict each other"}
    return [Missing(platform, python, extra, name, reason) for name, reason in found.items()]


def reason_against(needs: list[str], platform: str, python: str) -> str:
    """An empty text if wheels of all requirements fit the platform, else why not."""
    command = ["uv", "pip", "compile", "-", "--quiet", "--no-config", "--only-binary", ":all:", "--color", "never"]
    command += ["--python-platform", PLATFORMS[platform], "--python-version", python]
    environment = os.environ | {"MACOSX_DEPLOYMENT_TARGET": MACOS}
    done = subprocess.run(command, input="\n".join(needs), env=environment, capture_output=True, text=True)
    if not done.returncode:
        return ""
    if "No solution found" not in done.stderr:
        sys.exit(f"{', '.join(needs)} for {platform}: {done.stderr}")
    found = UNAVAILABLE.search(" ".join(done.stderr.split()))
    return f"no wheel of {found[1]}" if found else " ".join(done.stderr.split())


def table(extras: list[str], missing: list[Missing], options: argparse.Namespace) -> str:
    """A row for each extra, a column for each platform: yes, or what is missing."""
    rows = [f"| | {' | '.join(options.platforms)} |", "|---" * (len(options.platforms) + 1) + "|"]
    for extra in extras:
        of_platforms = (
            [one for one in missing if (one.extra, one.platform) == (extra, name)] for name in options.platforms
        )
        rows.append(f"| `{extra}` | {' | '.join(cell(found, options.pythons) for found in of_platforms)} |")
    return "\n".join(rows)


def cell(missing: list[Missing], pythons: tuple[str, ...]) -> str:
    """What a platform lacks of an extra, with the Pythons if others have it."""
    names = dict.fromkeys(one.name for one in missing)
    lacking = {name: [one.python for one in missing if one.name == name] for name in names}
    texts = (name if len(of) == len(pythons) else f"{name} ({', '.join(of)})" for name, of in lacking.items())
    return f"no {', '.join(texts)}" if lacking else "yes"


def reasons(missing: list[Missing]) -> list[tuple[str, str, str]]:
    """Platform, requirement and reason, each once."""
    return sorted({(one.platform, one.name, one.reason) for one in missing})


if __name__ == "__main__":
    main()
