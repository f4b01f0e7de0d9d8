"""Folder of a run: its settings and its environment. A run can only be resumed with the same settings."""

import contextlib
import datetime
import importlib.metadata
import json
import os
import platform
import shlex
import subprocess
import sys
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

import jax

from sglpr_jax.files import exclusive_lock, read_json, remove_half_written, write_json

CONFIG_FILE = "config.json"
ENVIRONMENT_FILE = "environment.json"
CHECKPOINTS = "checkpoints"
PACKAGES = ("sglpr-jax", "jax", "jaxlib", "flax", "optax", "numpy")
_CHECKOUT = Path(__file__).resolve().parents[2]


@contextlib.contextmanager
def lock_run(
    folder: Path, settings: Mapping[str, Any], *, seed: int, resume: bool, limits: Collection[str]
) -> Iterator[None]:
    """Lock the folder of a run during the block. First write settings and environment, and remove unfinished files.

    With `resume`, the folder must have a run with these settings, except for `limits` such as `config.steps`.

    Raises:
      FileExistsError: The folder already has a run, and `resume` is false.
      BlockingIOError: Another process trains in the folder.
      ValueError: Settings differ (see `require_same_settings`).
      FileNotFoundError: There is no run to resume.
    """
    path = folder / CONFIG_FILE
    if resume:
        require_same_settings(folder, settings, limits=limits)
    with exclusive_lock(folder):
        if path.exists() and not resume:
            raise FileExistsError(
                f"{folder}: there is a run already; resume it (--resume) or choose another folder (--out)"
            )
        remove_half_written(folder)
        write_json(path, _as_json(settings))
        note_environment(folder, seed=seed)
        yield


def require_same_settings(folder: Path, settings: Mapping[str, Any], *, limits: Collection[str]) -> None:
    """Check that the run in `folder` has these settings, except for `limits`.

    Raises FileNotFoundError if there is no run, and ValueError with the names of the settings that differ.
    """
    path = folder / CONFIG_FILE
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a run to resume, found none")
    different = sorted(_different_settings(read_json(path), _as_json(settings)) - set(limits))
    if different:
        raise ValueError(f"{path}: expected the settings of the run to resume, found others: {', '.join(different)}")


def _as_json(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings as they would be read from a JSON file: lists instead of tuples, texts instead of paths."""
    return json.loads(json.dumps(settings, default=str))


def _different_settings(old: Any, new: Any, name: str = "") -> set[str]:
    """Return the dotted names (`config.loss.margin`) of the settings that differ. `name` is that of the two values."""
    if not (isinstance(old, dict) and isinstance(new, dict)):
        return set() if old == new else {name}
    different: set[str] = set()
    for key in old.keys() | new.keys():
        key_name = f"{name}.{key}" if name else key
        different |= _different_settings(old.get(key), new.get(key), key_name)
    return different


def note_environment(folder: Path, *, seed: int) -> None:
    """Write the environment of a run into its folder. A resumed run appends its environment under `resumes`."""
    path = folder / ENVIRONMENT_FILE
    environment = {
        "time": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "command": shlex.join(sys.argv),
        "git": git_commit(_CHECKOUT),
        "python": platform.python_version(),
        "packages": {
            name: next((package.version for package in importlib.metadata.distributions(name=name)), None)
            for name in PACKAGES
        },
        "platform": platform.platform(),
        "cores": os.cpu_count(),
        "backend": jax.default_backend(),
        "devices": [device.device_kind for device in jax.devices()],
        "variables": {name: value for name, value in sorted(os.environ.items()) if name.startswith(("JAX_", "XLA_"))},
        "seed": seed,
    }
    if not path.exists():
        write_json(path, environment | {"resumes": []})
        return
    first = read_json(path)
    if not isinstance(first, dict) or not isinstance(first.get("resumes"), list):
        raise ValueError(f"{path}: expected the environment of a run with a list `resumes`, found {first!r:.60}")
    write_json(path, first | {"resumes": [*first["resumes"], environment]})


def checkpoint_steps(folder: Path) -> list[int]:
    """Return the steps of all checkpoints in `folder`, in order."""
    return sorted(int(path.name) for path in folder.glob("*") if path.name.isdecimal())


def git_commit(checkout: Path) -> dict[str, Any] | None:
    """Return the commit of a Git checkout and whether its files differ (`dirty`). None without Git or a checkout."""
    if not (checkout / ".git").exists():
        return None

    def run_git(*arguments: str) -> str:
        command = ["git", "-C", str(checkout), *arguments]
        return subprocess.run(command, check=True, capture_output=True, text=True, timeout=30).stdout.strip()

    try:
        return {"commit": run_git("rev-parse", "HEAD"), "dirty": bool(run_git("status", "--porcelain"))}
    except (OSError, subprocess.SubprocessError):
        return None
