"""Record of the software, the machine and the command of a run (environment.json)."""

import datetime
import importlib.metadata
import os
import platform
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax

from sglpr_jax.files import read_json, write_json

ENVIRONMENT_FILE = "environment.json"
PACKAGES = ("sglpr-jax", "jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "numpy")
_CHECKOUT = Path(__file__).resolve().parents[2]


def note_environment(folder: Path, *, seed: int) -> None:
    """Write the environment of a run into its folder. A resumed run appends its environment under `resumes`.

    Raises ValueError if the existing file is damaged.
    """
    path = folder / ENVIRONMENT_FILE
    now = environment() | {"seed": seed}
    if not path.exists():
        write_json(path, now | {"resumes": []})
        return
    first = read_json(path)
    resumes = first.get("resumes") if isinstance(first, dict) else None
    if not isinstance(resumes, list):
        raise ValueError(f"{path}: expected the environment of a run with a list `resumes`, found {first!r:.60}")
    write_json(path, first | {"resumes": [*resumes, now]})


def environment() -> dict[str, Any]:
    """Return the versions, the machine, the commit and the command line of this process."""
    return {
        "time": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "command": shlex.join(sys.argv),
        "git": git_commit(_CHECKOUT),
        "python": platform.python_version(),
        "packages": {name: _version(name) for name in PACKAGES},
        "platform": platform.platform(),
        "cores": os.cpu_count(),
        "backend": jax.default_backend(),
        "devices": [device.device_kind for device in jax.devices()],
        "variables": {name: value for name, value in sorted(os.environ.items()) if name.startswith(("JAX_", "XLA_"))},
    }


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:  # the package runs from a checkout without installation
        return None


def git_commit(checkout: Path) -> dict[str, Any] | None:
    """Return the commit of a checkout and whether its files differ from it.

    Returns None without a checkout or without git.
    """
    if not (checkout / ".git").exists():
        return None
    try:
        commit, changes = _git(checkout, "rev-parse", "HEAD"), _git(checkout, "status", "--porcelain")
    except (OSError, subprocess.SubprocessError):
        return None
    return {"commit": commit, "dirty": bool(changes)}


def _git(checkout: Path, *arguments: str) -> str:
    command = ["git", "-C", str(checkout), *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True, timeout=30).stdout.strip()
