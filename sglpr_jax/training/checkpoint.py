"""Checkpoints of a training run: folders that are complete or absent, with the SHA-256 of every file.

17/               state after step 17, written by Orbax, and about.json: measurements of the run, and checksums
damaged-17/       renamed checkpoint whose files do not match their checksums

The newest two checkpoints are kept.
"""

import contextlib
import hashlib
import json
import shutil
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp

from sglpr_jax.files import in_short, json_text, read_json, replacing
from sglpr_jax.models.weights_file import check_arrays
from sglpr_jax.training.devices import is_first_host, on_all_hosts
from sglpr_jax.training.run_folder import checkpoint_steps
from sglpr_jax.training.step import TrainState

_KEPT_CHECKPOINTS = 2
_STATE, _ABOUT = "state", "about.json"
_MAX_ERROR_LENGTH = 500
"""Maximum number of characters of an error of Orbax."""


class Checkpoints:
    """Checkpoints in one folder, which all hosts share. The first host writes them."""

    def __init__(self, folder: Path):
        """Rename damaged checkpoints and report them on stderr. Raises ValueError if all checkpoints are damaged."""
        self._folder = folder.resolve()
        on_all_hosts(lambda: is_first_host() and rename_damaged(self._folder))
        self.latest_step = max(checkpoint_steps(self._folder), default=None)
        """Step of the newest checkpoint, or None."""

    def save(self, state: TrainState, about: Mapping[str, Any]) -> None:
        """Write the state under its step, with JSON values. An existing checkpoint of that step stays unchanged.

        Raises OSError if the checkpoint cannot be written. The earlier ones are then intact.
        """
        step = int(state.step)
        if step != self.latest_step:
            on_all_hosts(lambda: is_first_host() and self._write(state, about))
            self.latest_step = step

    def restore(self, like: TrainState) -> tuple[TrainState, dict[str, Any]]:
        """Return the newest state, in host memory, and the JSON values about it.

        Raises ValueError if there is no checkpoint, or if its arrays differ from those of `like` in name or shape.
        """
        if self.latest_step is None:
            raise ValueError(f"{self._folder}: expected a checkpoint to resume from, found none")
        path = self._path(self.latest_step)
        return _read_state(path, like), read_json(path / _ABOUT)["about"]

    def _write(self, state: TrainState, about: Mapping[str, Any]) -> None:
        """Write a checkpoint, completely or not at all, and delete all but the newest two."""
        arrays = {name: np.array(leaf) for name, leaf in _arrays_by_name(state).items()}
        with replacing(self._path(int(state.step))) as temporary, _shortened_errors(temporary), _orbax() as orbax:
            orbax.save(temporary / _STATE, args=ocp.args.StandardSave(arrays))
            content = {"about": about, "sha256": _checksums(temporary, about)}
            (temporary / _ABOUT).write_text(json_text(content))
        for step in checkpoint_steps(self._folder)[:-_KEPT_CHECKPOINTS]:
            # renamed first, because a partly deleted checkpoint would seem damaged
            shutil.rmtree(self._path(step).rename(self._folder / f".{step}.old"))

    def _path(self, step: int) -> Path:
        return self._folder / f"{step}"


def rename_damaged(folder: Path) -> None:
    """Rename the checkpoints in `folder` whose files do not match their checksums, and report them on stderr.

    If all checkpoints are damaged, the function renames none and raises ValueError. It also deletes checkpoints whose
    deletion was interrupted (`.17.old`).
    """
    for half_deleted in folder.glob(".*.old"):
        shutil.rmtree(half_deleted)
    paths = [folder / f"{step}" for step in checkpoint_steps(folder)]
    damages = {path: damage for path in paths if (damage := _find_damage(path)) is not None}
    if damages and len(damages) == len(paths):
        raise ValueError(f"{folder}: expected a whole checkpoint, found {len(paths)} damaged: {damages[paths[-1]]}")
    for path, damage in damages.items():
        names = [f"damaged-{path.name}", *(f"damaged-{path.name}-{number}" for number in range(2, 100))]
        new_path = next(folder / name for name in names if not (folder / name).exists())
        path.rename(new_path)
        print(f"damaged checkpoint set aside as {new_path.name}: {damage}", file=sys.stderr)


def _find_damage(path: Path) -> str | None:
    """Describe the first damaged file of a checkpoint, or return None if all files match their checksums."""
    file = path / _ABOUT
    try:
        content = read_json(file)
        expected, actual = content["sha256"], _checksums(path, content["about"])
        damaged = {name for name in {*expected, *actual} if expected.get(name) != actual.get(name)}
    except (ValueError, OSError) as error:
        return str(error)
    except (KeyError, TypeError, AttributeError):
        return f"{file}: expected a description with checksums, found another"
    if not damaged:
        return None
    name = min(damaged)
    return f"{path / name}: expected SHA-256 {expected.get(name)}, found {actual.get(name, 'no such file')}"


def _checksums(path: Path, about: Mapping[str, Any]) -> dict[str, str]:
    """Return the SHA-256 of every file of the state in a checkpoint, and of the JSON values about the run."""
    contents = {
        file.relative_to(path).as_posix(): file.read_bytes()
        for file in sorted((path / _STATE).rglob("*"))
        if file.is_file()
    }
    contents[_ABOUT] = json.dumps(about).encode()
    return {name: hashlib.sha256(content).hexdigest() for name, content in contents.items()}


def _read_state(path: Path, like: TrainState) -> TrainState:
    """Read the state of a checkpoint. `check_arrays` raises ValueError unless its arrays are like those of `like`."""
    expected = _arrays_by_name(like)
    with _orbax() as orbax:
        stored: Any = orbax.metadata(path / _STATE).item_metadata
        check_arrays(stored.tree, expected, source=path)
        empty = {name: np.empty(leaf.shape, leaf.dtype) for name, leaf in expected.items()}
        arrays = orbax.restore(path / _STATE, args=ocp.args.StandardRestore(empty))
    check_arrays(arrays, expected, source=path)
    return jax.tree.unflatten(jax.tree.structure(like), [arrays[name] for name in expected])


def _arrays_by_name(state: TrainState) -> dict[str, Any]:
    """Return every array of the state by its path in the tree, such as `params/weights/...`."""
    leaves = jax.tree_util.tree_leaves_with_path(state)
    return {jax.tree_util.keystr(path, simple=True, separator="/"): leaf for path, leaf in leaves}


def _orbax() -> ocp.Checkpointer:
    """Return a checkpointer of Orbax that does not wait for other hosts: the first host writes, and all hosts read."""
    host = jax.process_index()
    options = ocp.options.MultiprocessingOptions(
        primary_host=host, active_processes={host}, barrier_sync_key_prefix=f"host{host}"
    )
    return ocp.Checkpointer(
        ocp.StandardCheckpointHandler(multiprocessing_options=options), multiprocessing_options=options
    )


@contextlib.contextmanager
def _shortened_errors(folder: Path) -> Iterator[None]:
    """Turn the long errors of Orbax, which repeat the folder, into an OSError of one line."""
    try:
        yield
    except (OSError, ValueError) as error:
        message = str(error).replace(f"{folder}", folder.name)
        reason = getattr(error, "strerror", None) or in_short(message, most=_MAX_ERROR_LENGTH)
        raise OSError(reason) from error
