"""bin/train: train on all drives but one, then test on that one, beside references."""

import dataclasses
import importlib.util
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from sglpr_jax.cli.datasets import all_drives, dataset_root, leave_one_out
from sglpr_jax.cli.final_test import final_test
from sglpr_jax.cli.presets import load_preset, preset_asked_for, preset_names
from sglpr_jax.cli.runtime import run, stop_on_signal, write_json
from sglpr_jax.cli.training_batches import batches, positions_of, tuple_pool
from sglpr_jax.cli.training_recall import training_recall
from sglpr_jax.cli.validation import validation_score
from sglpr_jax.data import Drive, ScanSequence
from sglpr_jax.data.held_out import hold_out
from sglpr_jax.data.kitti import PoseChoice
from sglpr_jax.data.tuples import TuplePool
from sglpr_jax.evaluation import figures
from sglpr_jax.models.params import save
from sglpr_jax.models.sglpr import Params
from sglpr_jax.train.config import TrainConfig
from sglpr_jax.train.describe_places import describe_places
from sglpr_jax.train.loop import METRICS_FILE, best_params, train
from sglpr_jax.train.metrics_log import read_metrics
from sglpr_jax.train.mining import FOLDER as MINING
from sglpr_jax.train.mining import DescribeFn, Mining

CONFIG_FILE = "config.json"


@dataclasses.dataclass(frozen=True)
class TrainCommand:
    """Train a model on all drives of a dataset but one, and test it on that one (leave-one-out).

    Examples:
      bin/train --seq 08                                  on the simulated drives, preset small
      bin/train --seq 08 --data KITTI --preset paper
      bin/train --seq 08 --data KITTI --resume            goes on where the run was stopped
      bin/train --seq 06 --data IMAGES --also SIMULATED --also-tuples 4     semantics from a second, labelled dataset
      bin/train --seq 08 --optimizer.learning-rate 1e-4   any field of the preset can be set
      bin/train --seq 08 --model.head.cbam False          an ablation; docs/ablations.md has all
    """

    seq: str = "08"
    """The drive to test on; it is never trained on."""
    data: Path | None = None
    """The dataset's folder: KITTI's layout, or ready-made BEV images. None: the simulated drives."""
    also: tuple[Path, ...] = ()
    """Further datasets, all of whose drives are trained on, with --also-tuples of a step's tuples: simulated scans with
    labels, say, beside real images without."""
    preset: str = "small"
    """A file of configs/ by name, or a path to one of your own."""
    out: Path | None = None
    """The run's folder. None: runs/PRESET-SEQ."""
    resume: bool = False
    """Go on from the run's newest checkpoint."""
    train_seqs: tuple[str, ...] = ()
    """The drives to train on. Empty: all but the one tested."""
    poses: PoseChoice = "auto"
    """Which poses of KITTI's layout: SemanticKITTI's (sequences/NN/poses.txt) or KITTI's own (poses/NN.txt)."""
    config: Annotated[TrainConfig, tyro.conf.arg(name=""), tyro.conf.FlagConversionOff] = dataclasses.field(
        default_factory=TrainConfig
    )


def parse(arguments: list[str] | None = None) -> TrainCommand:
    """Defaults, overridden by the preset, overridden by the flags."""
    preset = preset_asked_for(arguments, default=TrainCommand.preset)
    default = TrainCommand(preset=preset, config=load_preset(preset))
    return tyro.cli(TrainCommand, args=arguments, default=default, prog="train", description=_description())


def train_and_test(command: TrainCommand) -> Path:
    """Do what the command says; returns the run's folder."""
    folder = run_folder(command)
    params, test = train_only(command)
    final_test(params, test, folder / "test", seed=command.config.seed)
    return folder


def run_folder(command: TrainCommand) -> Path:
    """Where everything of the run goes."""
    return command.out or Path("runs") / f"{Path(command.preset).stem}-{command.seq}"


def train_only(command: TrainCommand) -> tuple[Params, Drive]:
    """Train, and save the weights; returns them with the drive to test on. Exits with 130 where it is interrupted."""
    folder = run_folder(command)
    config = command.config
    drives, also, test = _drives(command)
    splits = [hold_out(positions_of(drive), config.validation, config.sampling) for drive in drives]
    pool = tuple_pool(drives, config, frames=[split.training for split in splits])
    mining = None
    if config.sampling.mining == "hardest":
        mining = Mining(_describe_unturned(drives, pool, config), len(pool), config, folder / MINING)
    make_batch = batches(drives, pool, config, also=also, mining=mining)
    if config.validation.share:
        score = validation_score(drives, [split.validation for split in splits], config)
    else:
        score = training_recall(drives, pool, config)
    _claim(folder, command, resume=command.resume)
    with stop_on_signal() as stopped:
        refresh = mining.refresh if mining else None
        state = train(config, make_batch, folder, score=score, refresh=refresh, resume=command.resume, stopped=stopped)
    if int(state.step) < config.steps:
        save(state.params, folder / "weights")
        print(f"stopped at step {int(state.step)} of {config.steps}; go on with --resume", file=sys.stderr)
        sys.exit(130)
    params = best_params(folder, config) if config.select == "best" else state.params
    save(params, folder / "weights")
    draw_learning_curve(folder)
    return params, test


def _drives(command: TrainCommand) -> tuple[list[Drive], list[Drive], Drive]:
    """The drives to train on, those of --also, and the one to test on. ValueError where one cannot be used."""
    root = dataset_root(command.data)
    drives, test = leave_one_out(root, command.seq, train_seqs=command.train_seqs, poses=command.poses)
    also = [drive for folder in command.also for drive in all_drives(folder, poses=command.poses)]
    if any(folder.resolve() == root.resolve() for folder in command.also):
        raise ValueError(f"--also {root}: expected another dataset than the one whose drive {command.seq} is tested")
    if bool(also) != bool(command.config.also_tuples):
        raise ValueError(
            "--also names datasets and --also-tuples how many tuples of a step are theirs: expected both or neither, "
            f"found {len(command.also)} datasets and {command.config.also_tuples} tuples"
        )
    if command.config.model.categories_read:
        for drive in (*drives, *also, test):
            _require_labels(drive)
    return drives, also, test


def _describe_unturned(drives: Sequence[Drive], pool: TuplePool, config: TrainConfig) -> DescribeFn:
    return lambda params, places: describe_places(params, drives, pool, places, np.zeros(len(places)), config)


def draw_learning_curve(folder: Path) -> None:
    """Draw a run's loss and its score, of what is held out or of its own places, over the steps."""
    if not importlib.util.find_spec("matplotlib"):
        return
    lines = read_metrics(folder / METRICS_FILE)
    held_out = any("recall_neighbours" in line for line in lines)
    names = {"loss": "loss", "score": "score of held-out places" if held_out else "recall@1 of training places"}
    curves = {title: [(line["step"], line[name]) for line in lines if name in line] for name, title in names.items()}
    figures.save(figures.learning_curve(curves, ylabel="loss, score"), folder / "learning-curve.png")


def _claim(folder: Path, command: TrainCommand, *, resume: bool) -> None:
    """Note the effective configuration in the run's folder, or see that a resumed run has the same."""
    path = folder / CONFIG_FILE
    if path.exists() and not resume:
        raise FileExistsError(f"{folder}: there is a run already; go on with --resume, or choose another --out")
    if resume:
        require_same_settings(folder, command)
    folder.mkdir(parents=True, exist_ok=True)
    write_json(path, _settings(command))


def require_same_settings(folder: Path, command: TrainCommand) -> None:
    """See that a run was begun with the settings of `command`, the number of steps apart.

    Raises FileNotFoundError where there is no run, ValueError, naming them, where settings differ.
    """
    path = folder / CONFIG_FILE
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a run to resume, found none")
    different = sorted(_differences(json.loads(path.read_text()), _settings(command)) - {"config.steps"})
    if different:
        raise ValueError(
            f"{path}: expected the same settings as before to resume, found others: {', '.join(different)}"
        )


def _settings(command: TrainCommand) -> dict[str, Any]:
    """The effective configuration as it is written beside the results."""
    plain = dataclasses.asdict(dataclasses.replace(command, out=None, resume=False))
    return json.loads(json.dumps(plain, default=str))


def _differences(a: Any, b: Any, prefix: str = "") -> set[str]:
    if not (isinstance(a, dict) and isinstance(b, dict)):
        return set() if a == b else {prefix.removesuffix(".")}
    return {name for key in a.keys() | b.keys() for name in _differences(a.get(key), b.get(key), f"{prefix}{key}.")}


def _require_labels(drive: Drive) -> None:
    labelled = sum(path is not None for path in drive.label_paths) if isinstance(drive, ScanSequence) else 0
    if labelled < len(drive):
        raise ValueError(
            f"model.head.input reads labels: expected labels beside every scan of sequence {drive.name}, "
            f"found {labelled} of {len(drive)}"
        )


def _description() -> str:
    return f"{TrainCommand.__doc__}\nPresets: {', '.join(preset_names())}"


def main() -> None:
    """The entry point."""
    run(lambda: print(f"run: {train_and_test(parse())}"))


if __name__ == "__main__":
    main()
