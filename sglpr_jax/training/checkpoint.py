"""Checkpoints of a training run: one safetensors file each, complete or absent, with the SHA-256 of its content.

17.safetensors            state after step 17, and as JSON what the run had measured
damaged-17.safetensors    renamed checkpoint whose content does not match its checksum
"""

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from sglpr_jax.files import replacing
from sglpr_jax.methods.learned.weights_file import check_leaves, checked_tensors, read_tensors
from sglpr_jax.training.devices import is_first_host, on_all_hosts
from sglpr_jax.training.step import TrainState

_KEPT = 2
"""Number of checkpoints that are kept, the newest ones."""
_SUFFIX, _ABOUT = ".safetensors", "about"


class Checkpoints:
    """Checkpoints in one folder, which all hosts share. The first host writes them."""

    def __init__(self, folder: Path):
        """Rename damaged checkpoints and report them on stderr. Raises ValueError if all checkpoints are damaged."""
        self._folder = folder.resolve()
        on_all_hosts(lambda: is_first_host() and set_damaged_aside(self._folder))
        self.latest_step = max(checkpoint_steps(self._folder), default=None)
        """Step of the newest checkpoint, or None."""

    def save(self, state: TrainState, about: Mapping[str, Any]) -> None:
        """Write the state under its step, with JSON values. An existing checkpoint of that step stays unchanged.

        Raises WriteError if the checkpoint cannot be written. The earlier ones are then intact.
        """
        step = int(state.step)
        if step != self.latest_step:
            on_all_hosts(lambda: is_first_host() and self._write(state, about))
            self.latest_step = step

    def restore(self, like: TrainState) -> tuple[TrainState, dict[str, Any]]:
        """Return the newest state, which has the arrays of `like`, in host memory, and the JSON values about it.

        Raises ValueError if there is no checkpoint, or if it belongs to another model.
        """
        if self.latest_step is None:
            raise ValueError(f"{self._folder}: expected a checkpoint to resume from, found none")
        path = self._path(self.latest_step)
        values, expected = read_tensors(path), _by_path(like)
        about = json.loads(values.pop(_ABOUT).tobytes())
        check_leaves(values, expected, source=path)
        return jax.tree.unflatten(jax.tree.structure(like), [values[name] for name in expected]), about

    def _write(self, state: TrainState, about: Mapping[str, Any]) -> None:
        values = {name: np.asarray(leaf, order="C") for name, leaf in _by_path(state).items()}
        content = checked_tensors({**values, _ABOUT: np.frombuffer(json.dumps(about).encode(), np.uint8)})
        with replacing(self._path(int(state.step))) as temporary:
            temporary.write_bytes(content)
        for step in checkpoint_steps(self._folder)[:-_KEPT]:
            self._path(step).unlink()

    def _path(self, step: int) -> Path:
        return self._folder / f"{step}{_SUFFIX}"


def checkpoint_steps(folder: Path) -> list[int]:
    """Return the steps of all checkpoints in `folder`, in order."""
    return sorted(int(path.stem) for path in folder.glob(f"*{_SUFFIX}") if path.stem.isdecimal())


def set_damaged_aside(folder: Path) -> None:
    """Rename the damaged checkpoints in `folder`, and report them on stderr.

    Raises ValueError, without renaming, if all are damaged, or if they are those of an earlier version.
    """
    earlier = next((path for path in folder.glob("*") if path.is_dir() and path.name.isdecimal()), None)
    if earlier is not None:
        raise ValueError(f"{earlier}: expected a file, found a checkpoint of version 0.1; finish the run with it")
    steps, damaged = checkpoint_steps(folder), dict[int, Exception]()
    for step in steps:
        try:
            read_tensors(folder / f"{step}{_SUFFIX}")
        except ValueError as error:
            damaged[step] = error
    if damaged and len(damaged) == len(steps):
        raise ValueError(f"{folder}: expected a whole checkpoint, found {len(damaged)} damaged: {damaged[steps[-1]]}")
    for step, error in damaged.items():
        aside = (folder / f"{step}{_SUFFIX}").replace(folder / f"damaged-{step}{_SUFFIX}")
        print(f"damaged checkpoint set aside as {aside.name}: {error}", file=sys.stderr)


def _by_path(state: TrainState) -> dict[str, Any]:
    """Return every array by its place in the state."""
    leaves = jax.tree_util.tree_leaves_with_path(state)
    return {jax.tree_util.keystr(path, simple=True, separator="/"): leaf for path, leaf in leaves}
