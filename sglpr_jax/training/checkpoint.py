"""Checkpoints of a training run. Checkpoints are written atomically with checksums. The newest ones and the best one
are kept.

This is the only file that imports orbax.

17/               one checkpoint: weights, optimizer, metrics, measurements that are not logged yet, checksums.json
damaged-17/       renamed checkpoint whose files do not match their checksums
"""

import asyncio
import contextlib
import shutil
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp
from orbax.checkpoint.checkpoint_managers import AnyPreservationPolicy, BestN, LatestN
from orbax.checkpoint.path import atomicity

from sglpr_jax.files import in_short
from sglpr_jax.models.params import Params
from sglpr_jax.training.checksums import damage, write_checksums
from sglpr_jax.training.config import TrainConfig
from sglpr_jax.training.hosts import is_first_host, on_all_hosts
from sglpr_jax.training.state import TrainState, new_state

_KEPT_LATEST = 2
_MOST_OF_AN_ERROR = 500
"""Maximum number of characters of an error of orbax, whose reason comes last. The folder is not counted."""
_INTACT = "the last checkpoint is intact"
_UNLOGGED = "unlogged"
_OUTDATED = "outdated"
"""Folder to which a checkpoint is moved before it is deleted. A partly deleted checkpoint would look like a valid
one."""


class _WithChecksums(atomicity.AtomicRenameTemporaryPath):
    """Temporary checkpoint folder that gets its checksums before it is renamed to its final name."""

    async def finalize(self) -> None:
        """Called once for each item, and once for the whole checkpoint."""
        if self.get_final().name.isdecimal():
            await asyncio.to_thread(write_checksums, Path(self.get()))
        await super().finalize()


class Checkpoints:
    """Checkpoints in one folder. Weights and optimiser state are separate items, so that each can be read alone."""

    def __init__(self, folder: Path):
        """Rename damaged checkpoints and report them on stderr. Raises ValueError if all checkpoints are damaged."""
        self._folder = folder.resolve()
        self._sweep()
        on_all_hosts(lambda: is_first_host() and set_damaged_aside(self._folder))
        policy = AnyPreservationPolicy([LatestN(_KEPT_LATEST), BestN(get_metric_fn=_score, n=1)])
        options = ocp.CheckpointManagerOptions(
            best_fn=_score,  # without it no scores are written, and a resumed run keeps all checkpoints
            preservation_policy=policy,
            cleanup_tmp_directories=True,
            todelete_subdir=_OUTDATED,
            temporary_path_class=_WithChecksums,
        )
        handlers: dict[str, Any] = {name: ocp.StandardCheckpointHandler() for name in ("weights", "optimizer")}
        handlers[_UNLOGGED] = ocp.JsonCheckpointHandler()
        self._manager = ocp.CheckpointManager(self._folder, options=options, item_handlers=handlers)

    def save(
        self, state: TrainState, *, score: float | None = None, unlogged: Sequence[Mapping[str, float]] = ()
    ) -> None:
        """Write the state under its step. An existing checkpoint of that step stays unchanged.

        Arguments:
          state: State to save.
          score: Score of the weights, if it was measured.
          unlogged: Measurements of the steps since the last line of the log.

        Raises:
          OSError: This checkpoint, or the previous one that is still being written, cannot be written.
        """
        step = int(state.step)
        if step in self._manager.all_steps():
            return
        self._wait()
        self._require_room(state)
        items = ocp.args.Composite(
            weights=ocp.args.StandardSave(state.params.weights),
            optimizer=ocp.args.StandardSave(state.optimizer),
            unlogged=ocp.args.JsonSave({_UNLOGGED: [dict(measured) for measured in unlogged]}),
        )
        with self._writing():
            self._manager.save(
                step,
                args=items,
                metrics={"score": -1.0 if score is None else score},
                force=True,
            )

    def latest_step(self) -> int | None:
        """Return the step of the newest complete checkpoint, or None."""
        return self._manager.latest_step()

    def restore(self, config: TrainConfig) -> TrainState:
        """Return the newest state, in host memory because the devices may differ from those of the saved run.

        Raises ValueError if there is no checkpoint, or if it belongs to another model.
        """
        self._wait()
        step = self.latest_step()
        if step is None:
            raise ValueError(f"{self._manager.directory}: expected a checkpoint to resume from, found none")
        like = jax.eval_shape(lambda: new_state(config))
        # Check before any array is read: if reading one fails, orbax abandons the others half-way.
        there, expected = _shapes(self._manager.item_metadata(step).weights), _shapes(like.params.weights)
        if there != expected:
            name = min(dict(set(there.items()) ^ set(expected.items())))
            raise ValueError(
                f"{self._manager.directory}/{step}: not a checkpoint of this configuration: expected {name} of shape "
                f"{expected.get(name, 'none (unknown weight)')}, found {there.get(name, 'none (missing)')}"
            )
        weights, moments = (
            jax.tree.map(lambda leaf: np.empty(leaf.shape, leaf.dtype), tree)
            for tree in (like.params.weights, like.optimizer)
        )
        items = ocp.args.Composite(
            weights=ocp.args.StandardRestore(weights), optimizer=ocp.args.StandardRestore(moments)
        )
        found: Any = self._manager.restore(step, args=items)
        return TrainState(np.int32(step), Params(found.weights, config.model), found.optimizer)

    def unlogged(self) -> list[dict[str, float]]:
        """Return the measurements that were saved with the newest state."""
        self._wait()
        found: Any = self._manager.restore(self.latest_step(), args=ocp.args.Composite(unlogged=ocp.args.JsonRestore()))
        return found.unlogged[_UNLOGGED]

    def best_params(self, config: TrainConfig) -> Params:
        """Return the weights with the best score among the kept checkpoints. Of several equal scores, the latest
        counts.

        Raises ValueError if there is no checkpoint.
        """
        self._manager.wait_until_finished()
        scores = {step: (self._manager.metrics(step) or {}).get("score", -1.0) for step in self._manager.all_steps()}
        if not scores:
            raise ValueError(f"{self._manager.directory}: expected a checkpoint with a score, found none")
        best = max(scores, key=lambda step: (scores[step], step))
        like = jax.eval_shape(lambda: new_state(config)).params.weights
        items = ocp.args.Composite(weights=ocp.args.StandardRestore(like))
        found: Any = self._manager.restore(best, args=items)
        return Params(found.weights, config.model)

    def close(self) -> None:
        """Wait until everything is written. Raises OSError if writing fails."""
        with self._writing():
            self._manager.close()
        self._sweep()

    def _wait(self) -> None:
        with self._writing():
            self._manager.wait_until_finished()
        self._sweep()

    def _sweep(self) -> None:
        shutil.rmtree(self._folder / _OUTDATED, ignore_errors=True)

    def _require_room(self, state: TrainState) -> None:
        """Raise OSError before writing if the disk has too little space for a checkpoint."""
        needed = sum(leaf.nbytes for leaf in jax.tree.leaves((state.params.weights, state.optimizer)))
        free = shutil.disk_usage(self._folder).free
        if free < needed:
            raise OSError(f"{self._folder}: expected {needed:,} bytes free for a checkpoint, found {free:,}; {_INTACT}")

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        """Replace the long errors of orbax by one line with the name of the folder."""
        try:
            yield
        except (OSError, ValueError) as error:
            named_once = str(error).replace(f"{self._folder}/", "")
            reason = getattr(error, "strerror", None) or in_short(
                named_once or type(error).__name__, most=_MOST_OF_AN_ERROR
            )
            raise OSError(f"{self._folder}: expected to write a checkpoint, found: {reason}; {_INTACT}") from error


def set_damaged_aside(folder: Path) -> None:
    """Rename the checkpoints in `folder` whose files do not match their checksums, and report them on stderr.

    If all checkpoints are damaged, the function renames none and raises ValueError.
    """
    steps = [path for path in folder.glob("*") if path.name.isdecimal()]
    damaged = {path: found for path in steps if (found := damage(path)) is not None}
    if damaged and len(damaged) == len(steps):
        newest = max(damaged, key=lambda path: int(path.name))
        raise ValueError(f"{folder}: expected a whole checkpoint, found {len(damaged)} damaged: {damaged[newest]}")
    for path, found in damaged.items():
        names = (path.with_name(f"damaged-{path.name}{suffix}") for suffix in ("", *map("-{}".format, range(2, 100))))
        aside = next(name for name in names if not name.exists())
        path.rename(aside)
        print(f"damaged checkpoint {path} set aside as {aside.name}: {found}", file=sys.stderr)


def _score(metrics: Any) -> float:
    return metrics["score"]


def _shapes(tree: Any) -> dict[str, tuple[int, ...]]:
    """Return the shape of every array by its path."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="/"): tuple(leaf.shape) for path, leaf in leaves}
