"""Checkpoints of a training run: one safetensors file each, complete or absent, with the SHA-256 of its values.

17.safetensors            state after step 17, and JSON about it: its score and what the run had measured and spent
damaged-17.safetensors    renamed file whose values do not match their checksum

The newest two checkpoints and the one with the best score are kept.
"""

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
import safetensors

from sglpr_jax.files import replacing
from sglpr_jax.methods.learned.weights_file import check_leaves, checked_tensors, read_tensors
from sglpr_jax.training.devices import is_first_host, on_all_hosts
from sglpr_jax.training.step import TrainState

ENDING = ".safetensors"
_KEPT_LATEST = 2
_ABOUT = "about"
"""Name of the array with the bytes of the JSON text, so that its checksum is that of the values."""


class Checkpoints:
    """Checkpoints in one folder, which all hosts share. The first host writes them."""

    def __init__(self, folder: Path):
        """Rename damaged checkpoints and report them on stderr. Raises ValueError if all checkpoints are damaged."""
        self._folder = folder.resolve()
        on_all_hosts(lambda: is_first_host() and set_damaged_aside(self._folder))
        self._scores = {step: _about(self._path(step))["score"] for step in checkpoint_steps(self._folder)}

    def save(self, state: TrainState, *, score: float | None = None, about: Mapping[str, Any] | None = None) -> None:
        """Write the state under its step. An existing checkpoint of that step stays unchanged.

        Arguments:
          state: State to save.
          score: Score of the weights, if it was measured.
          about: Further JSON values, which `restore` returns.

        Raises:
          OSError: The checkpoint cannot be written. The earlier ones are intact.
        """
        step = int(state.step)
        if step not in self._scores:
            score = -1.0 if score is None else score
            text = json.dumps({**(about or {}), "score": score})
            on_all_hosts(lambda: is_first_host() and self._write(state, text))
            self._scores[step] = score
            self._drop_old()

    @property
    def latest_step(self) -> int | None:
        """Step of the newest checkpoint, or None."""
        return max(self._scores, default=None)

    def restore(self, like: TrainState) -> tuple[TrainState, dict[str, Any]]:
        """Return the newest state, which has the arrays of `like`, in host memory, and the JSON values about it.

        Raises ValueError if there is no checkpoint, or if it belongs to another model.
        """
        if self.latest_step is None:
            raise ValueError(f"{self._folder}: expected a checkpoint to resume from, found none")
        path = self._path(self.latest_step)
        return _read(path, like), _about(path)

    def best(self, like: TrainState) -> TrainState:
        """Return the state with the best score. Of several equal scores, the latest counts.

        Raises ValueError if there is no checkpoint.
        """
        if not self._scores:
            raise ValueError(f"{self._folder}: expected a checkpoint with a score, found none")
        return _read(self._path(self._best_step()), like)

    def _write(self, state: TrainState, text: str) -> None:
        values = {name: np.asarray(leaf, order="C") for name, leaf in _by_path(state).items()}
        content = checked_tensors({**values, _ABOUT: np.frombuffer(text.encode(), np.uint8)})
        with replacing(self._path(int(state.step))) as temporary:
            temporary.write_bytes(content)

    def _drop_old(self) -> None:
        kept = {self._best_step(), *sorted(self._scores)[-_KEPT_LATEST:]}
        for step in self._scores.keys() - kept:
            del self._scores[step]
            if is_first_host():
                self._path(step).unlink()

    def _best_step(self) -> int:
        return max(self._scores, key=lambda step: (self._scores[step], step))

    def _path(self, step: int) -> Path:
        return self._folder / f"{step}{ENDING}"


def checkpoint_steps(folder: Path) -> list[int]:
    """Return the steps of all checkpoints in `folder`, in order."""
    return sorted(int(path.stem) for path in folder.glob(f"*{ENDING}") if path.stem.isdecimal())


def set_damaged_aside(folder: Path) -> None:
    """Rename the checkpoints in `folder` whose values do not match their checksum, and report them on stderr.

    If all checkpoints are damaged, the function renames none and raises ValueError.
    """
    paths = [folder / f"{step}{ENDING}" for step in checkpoint_steps(folder)]
    damaged = {path: found for path in paths if (found := _damage(path)) is not None}
    if damaged and len(damaged) == len(paths):
        raise ValueError(
            f"{folder}: expected a whole checkpoint, found {len(damaged)} damaged: {damaged[max(damaged, key=_step)]}"
        )
    for path, found in damaged.items():
        names = (
            path.with_name(f"damaged-{path.stem}{suffix}{ENDING}") for suffix in ("", *map("-{}".format, range(2, 100)))
        )
        aside = next(name for name in names if not name.exists())
        path.rename(aside)
        print(f"damaged checkpoint set aside as {aside.name}: {found}", file=sys.stderr)


def _damage(path: Path) -> str | None:
    try:
        if _ABOUT in read_tensors(path):
            return None
    except (ValueError, OSError) as error:
        return str(error)
    return f"{path}: expected a checkpoint, found other arrays"


def _step(path: Path) -> int:
    return int(path.stem)


def _read(path: Path, like: TrainState) -> TrainState:
    values, expected = read_tensors(path), _by_path(like)
    del values[_ABOUT]
    check_leaves(values, expected, source=path)
    return jax.tree.unflatten(jax.tree.structure(like), [values[name] for name in expected])


def _about(path: Path) -> dict[str, Any]:
    with safetensors.safe_open(path, framework="np") as file:
        return json.loads(file.get_tensor(_ABOUT).tobytes())


def _by_path(state: TrainState) -> dict[str, Any]:
    """Return every array by its place in the state."""
    leaves = jax.tree_util.tree_leaves_with_path(state)
    return {jax.tree_util.keystr(path, simple=True, separator="/"): leaf for path, leaf in leaves}
