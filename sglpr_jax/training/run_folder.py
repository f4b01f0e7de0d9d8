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
PACKAGES = ("sglpr-jax", "jax", "jaxlib", "flax", "optax", "numpy")
REMOVED = {"config.select": "last"}
"""Settings of earlier versions with the only value that runs have today."""
_CHECKOUT = Path(__file__).resolve().parents[2]


@contextlib.contextmanager
def lock_run(
    folder: Path, settings: Mapping[str, Any], *, seed: int, resume: bool, limits: Collection[str] = ()
) -> Iterator[None]:
    """Lock a run's folder while the block runs. Writes settings and environment, removes unfinished files.

    Arguments:
      folder: Folder of the run.
      settings: Content of config.json.
      seed: Seed of the run, for environment.json.
      resume: Continue the run in the folder.
      limits: Settings that may differ in a resumed run, such as `config.steps`.

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
    different = sorted(_differences(read_json(path), _as_json(settings)) - set(limits))
    if different:
        raise ValueError(f"{path}: expected the settings of the run to resume, found others: {', '.join(different)}")


def _as_json(settings: Mapping[str, Any]) -> dict[str, Any]:
    return json.loads(json.dumps(settings, default=str))


def _differences(a: Any, b: Any, prefix: str = "") -> set[str]:
    if not (isinstance(a, dict) and isinstance(b, dict)):
        return set() if a == b else {prefix.removesuffix(".")}
    return {
        name
        for key in a.keys() | b.keys()
        for name in _differences(a.get(key), b.get(key, REMOVED.get(prefix + key)), f"{prefix}{key}.")
    }


def note_environment(folder: Path, *, seed: int) -> None:
    """Write the environment of a run into its folder. A resumed run appends its environment under `resumes`."""
    path = folder / ENVIRONMENT_FILE
    now = {
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
        write_json(path, now | {"resumes": []})
        return
    begun = read_json(path)
    if not isinstance(begun, dict) or not isinstance(begun.get("resumes"), list):
        raise ValueError(f"{path}: expected the environment of a run with a list `resumes`, found {begun!r:.60}")
    write_json(path, begun | {"resumes": [*begun["resumes"], now]})


def git_commit(checkout: Path) -> dict[str, Any] | None:
    """Return the commit of a checkout and whether its files differ from it, or None without a checkout or git."""
    if not (checkout / ".git").exists():
        return None

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(checkout), *arguments]
        return subprocess.run(command, check=True, capture_output=True, text=True, timeout=30).stdout.strip()

    try:
        return {"commit": git("rev-parse", "HEAD"), "dirty": bool(git("status", "--porcelain"))}
    except (OSError, subprocess.SubprocessError):
        return None
