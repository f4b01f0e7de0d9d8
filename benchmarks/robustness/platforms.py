"""Whether PyPI has wheels of every dependency, for each platform and Python."""

import datetime
import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

from benchmarks.table import Table

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
NOT_OF_USERS = ("dev",)
"""Extras of those who work on the library itself."""
UNAVAILABLE = re.compile(r"\b([A-Za-z][\w.-]*?)(?:[<>=!]\S*)? (?:has|have) no (?:usable )?wheels")
MACOS = "14.0"
"""Version of macOS. By default uv takes 13.0, for which small-gicp has no wheel."""


def platforms(*, extras: tuple[str, ...] = ()) -> None:
    """Print a table of platforms with wheels of every dependency, and what is missing.

    Each extra of pyproject.toml is resolved with all that it needs, from wheels only. Nothing is installed. The program
    is `uv pip compile` (pip install uv): unlike pip, it applies the conditions of the other platform.

    Args:
        extras: extras of pyproject.toml; without them all, and what is required.
    """
    if shutil.which("uv") is None:
        sys.exit("expected the program uv, found none; pip install uv")
    project, reasons = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"], set[str]()
    requirements = {"required": project["dependencies"], **project["optional-dependencies"]}
    print(f"{datetime.date.today()}, Python {', '.join(PYTHONS)}\n")
    table = Table("", *PLATFORMS)
    for extra, needs in requirements.items():
        if extra in NOT_OF_USERS or (extras and extra not in extras):
            continue
        cells = []
        for platform in PLATFORMS:
            pythons_without: dict[str, list[str]] = {}
            for python in PYTHONS:
                for name, why in _missing(needs, platform, python).items():
                    pythons_without.setdefault(name, []).append(python)
                    reasons.add(f"{platform}, {name}: {why}")
            texts = [
                name if len(pythons) == len(PYTHONS) else f"{name} ({', '.join(pythons)})"
                for name, pythons in pythons_without.items()
            ]
            cells.append(f"no {', '.join(texts)}" if texts else "yes")
        table.add(f"`{extra}`", *cells)
    print("", *sorted(reasons), sep="\n")


def _missing(needs: list[str], platform: str, python: str) -> dict[str, str]:
    """Requirements without a wheel, and why. All are tried together first, and singly if that fails."""
    if not _reason_against(needs, platform, python):
        return {}
    singly = {re.split(r"[\[<>=!; ]", need)[0]: _reason_against([need], platform, python) for need in needs}
    missing = {name: reason for name, reason in singly.items() if reason}
    return missing or {" with ".join(needs): "their needs contradict each other"}


def _reason_against(needs: list[str], platform: str, python: str) -> str:
    """An empty text if wheels of all requirements fit the platform, else why not."""
    command = ["uv", "pip", "compile", "-", "--quiet", "--no-config", "--only-binary", ":all:", "--color", "never"]
    command += ["--python-platform", PLATFORMS[platform], "--python-version", python]
    environment = os.environ | {"MACOSX_DEPLOYMENT_TARGET": MACOS}
    done = subprocess.run(command, input="\n".join(needs), env=environment, capture_output=True, text=True)
    if not done.returncode:
        return ""
    if "No solution found" not in done.stderr:
        sys.exit(f"{', '.join(needs)} for {platform}: {done.stderr}")
    unavailable = UNAVAILABLE.search(" ".join(done.stderr.split()))
    return f"no wheel of {unavailable[1]}" if unavailable else " ".join(done.stderr.split())
