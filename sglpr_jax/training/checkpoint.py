"""Checkpoints of a training run: atomic, with checksums, the newest and the best kept. The one file that knows orbax.

17/               one checkpoint: weights, optimizer, metrics, what was measured and not logged yet, checksums.json
damaged-17/       one that is not as it was written; it was set aside
"""

import asyncio
import contextlib
import os
import re
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

from sglpr_jax.models.params import Params
from sglpr_jax.training.checksums import damage, write_checksums
from sglpr_jax.training.config import TrainConfig
from sglpr_jax.training.hosts import is_first_host, on_all_hosts
from sglpr_jax.training.state import TrainState, new_state

_KEPT_LATEST = 2
_INTACT = "the last checkpoint is intact"
_UNLOGGED = "unlogged"
_OUTDATED = "outdated"
"""Checkpoints are moved here whole before they are deleted: one deleted in part would look like a checkpoint."""


class _WithChecksums(atomicity.AtomicRenameTemporaryPath):
    """A checkpoint under its temporary name, which gets its checksums before its own name."""

    async def finalize(self) -> None:
        """Called once for each item, and once for all of them."""
        if self.get_final().name.isdecimal():
            await asyncio.to_thread(write_checksums, Path(self.get()))
        await super().finalize()


class Checkpoints:
    """The checkpoints in one folder; weights and optimiser are separate items, so that either can be read alone."""

    def __init__(self, folder: Path):
        """Damaged checkpoints are named on stderr and set aside. Raises ValueError where no other one is there."""
        self._folder = folder.resolve()
        self._sweep()
        on_all_hosts(lambda: is_first_host() and set_damaged_aside(self._folder))
        policy = AnyPreservationPolicy([LatestN(_KEPT_LATEST), BestN(get_metric_fn=_score, n=1)])
        options = ocp.CheckpointManagerOptions(
            best_fn=_score,  # without it scores are not written, and a resumed run keeps all it finds
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
        """Write the state under its step, with its score if it has one. A step already there is left as it is.

        `unlogged` are the measurements of the steps since the last line of the log. Raises OSError where this
        checkpoint or the one before it, written meanwhile, cannot be written.
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
        """The newest whole checkpoint's step, or None."""
        return self._manager.latest_step()

    def restore(self, config: TrainConfig) -> TrainState:
        """The newest state, in host memory: the devices it was saved from may be others than those it goes to.

        Raises ValueError when there is none or it belongs to another model.
        """
        self._wait()
        step = self.latest_step()
        if step is None:
            raise ValueError(f"{self._manager.directory}: expected a checkpoint to resume from, found none")
        like = jax.eval_shape(lambda: new_state(config))
        # Before any array is read: where reading one fails, orbax drops the others half-way.
        there, expected = _shapes(self._manager.item_metadata(step).weights), _shapes(like.params.weights)
        if there != expected:
            name = min(dict(set(there.items()) ^ set(expected.items())))
            raise ValueError(
                f"{self._manager.directory}/{step}: not a checkpoint of this configuration: expected {name} of shape "
                f"{expected.get(name, 'none (no such weight)')}, found {there.get(name, 'none (missing)')}"
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
        """The measurements that the newest state was saved with."""
        self._wait()
        found: Any = self._manager.restore(self.latest_step(), args=ocp.args.Composite(unlogged=ocp.args.JsonRestore()))
        return found.unlogged[_UNLOGGED]

    def best_params(self, config: TrainConfig) -> Params:
        """The weights of the best score among the checkpoints kept, the later of equal ones. ValueError without one."""
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
        """Wait until everything is written. Raises OSError where it cannot be."""
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
        """Raise OSError where the disk is too full for a checkpoint, before a part of one is written."""
        needed = sum(leaf.nbytes for leaf in jax.tree.leaves((state.params.weights, state.optimizer)))
        free = shutil.disk_usage(self._folder).free
        if free < needed:
            raise OSError(f"{self._folder}: expected {needed:,} bytes free for a checkpoint, found {free:,}; {_INTACT}")

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        """Say in one line, with the folder's name, what orbax and the writers below it say in many."""
        try:
            yield
        except (OSError, ValueError) as error:
            code = re.search(r"os_error_code='(\d+)'", str(error))
            reason = os.strerror(int(code[1])) if code else getattr(error, "strerror", None) or error
            raise OSError(f"{self._folder}: expected to write a checkpoint, found: {reason}; {_INTACT}") from error


def set_damaged_aside(folder: Path) -> None:
    """Rename the checkpoints in `folder` whose files are not as they were written, and say so on stderr.

    Raises ValueError, and renames none, where all of them are damaged.
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
    """The shape of every array by its path."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="/"): tuple(leaf.shape) for path, leaf in leaves}
