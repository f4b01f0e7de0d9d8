"""The Dockerfile copies files that exist, and its entry point runs the commands of the package."""

import os
import re
import subprocess
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
DOCKERFILE = (ROOT / "docker" / "Dockerfile").read_text()
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def entry_point(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run the entry point with two commands installed in `folder`/bin."""
    (folder / "bin").mkdir(exist_ok=True)
    for name in ("sglpr-loops", "sglpr-live"):
        path = folder / "bin" / name
        path.write_text(f'#!/bin/sh\necho "{name}:$*"\n')
        path.chmod(0o755)
    environment = {"VIRTUAL_ENV": str(folder), "PATH": f"{folder}/bin:{os.environ['PATH']}"}
    command = [str(ROOT / "docker" / "sglpr"), *words]
    return subprocess.run(command, env=environment, capture_output=True, text=True)


def test_copied_files_exist_and_are_not_ignored():
    ignored = (ROOT / "docker" / "Dockerfile.dockerignore").read_text().splitlines()
    copies = re.findall(r"^COPY (?!--from)(?:--\S+ )?(.+) \S+$", DOCKERFILE, re.MULTILINE)
    names = " ".join(copies).split()
    assert len(names) == 7
    for name in names:
        assert (ROOT / name).exists() and f"!{name.partition('/')[0]}" in ignored


def test_commands_run_with_and_without_the_prefix_and_an_unknown_one_lists_them(tmp_path):
    for name in ("loops", "sglpr-loops"):
        assert entry_point(tmp_path, name, "my scans").stdout == "sglpr-loops:my scans\n"
    done = entry_point(tmp_path, "lops")
    assert done.returncode == 1 and "  live\n  loops\n" in done.stderr
