"""Checkpoints of a training run: atomic, the newest and the best kept. The one file that knows orbax."""

from pathlib import Path
from typing import Any

import jax
import orbax.checkpoint as ocp
from orbax.checkpoint.checkpoint_managers import AnyPreservationPolicy, BestN, LatestN

from sglpr_jax.models.sglpr import Params
from sglpr_jax.train.config import TrainConfig
from sglpr_jax.train.state import TrainState, new_state

_KEPT_LATEST = 2


class Checkpoints:
    """The checkpoints in one folder; weights and optimiser are separate items, so that either can be read alone."""

    def __init__(self, folder: Path):
        policy = AnyPreservationPolicy([LatestN(_KEPT_LATEST), BestN(get_metric_fn=_score, n=1)])
        # Without `best_fn` scores are not written down, and a resumed run would not know its best checkpoint.
        options = ocp.CheckpointManagerOptions(preservation_policy=policy, best_fn=_score, cleanup_tmp_directories=True)
        handlers = {name: ocp.StandardCheckpointHandler() for name in ("weights", "optimizer")}
        self._manager = ocp.CheckpointManager(folder.resolve(), options=options, item_handlers=handlers)

    def save(self, state: TrainState, *, score: float | None = None) -> None:
        """Write the state under its step, with its score if it has one. A step already there is left as it is."""
        step = int(state.step)
        if step in self._manager.all_steps():
            return
        items = ocp.args.Composite(
            weights=ocp.args.StandardSave(state.params.weights), optimizer=ocp.args.StandardSave(state.optimizer)
        )
        self._manager.save(step, args=items, metrics={"score": -1.0 if score is None else score}, force=True)

    def latest_step(self) -> int | None:
        """The newest whole checkpoint's step, or None."""
        return self._manager.latest_step()

    def restore(self, config: TrainConfig) -> TrainState:
        """The newest state. Raises ValueError when there is none or it belongs to another model."""
        self._manager.wait_until_finished()
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
        items = ocp.args.Composite(
            weights=ocp.args.StandardRestore(like.params.weights), optimizer=ocp.args.StandardRestore(like.optimizer)
        )
        found: Any = self._manager.restore(step, args=items)
        return TrainState(jax.numpy.asarray(step, "int32"), Params(found.weights, config.model), found.optimizer)

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
        """Wait until everything is written."""
        self._manager.close()


def _score(metrics: Any) -> float:
    return metrics["score"]


def _shapes(tree: Any) -> dict[str, tuple[int, ...]]:
    """The shape of every array by its path."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="/"): tuple(leaf.shape) for path, leaf in leaves}
