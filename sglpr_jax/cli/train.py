"""bin/train: train on all drives but one, then test on that one, beside references."""

import contextlib
import dataclasses
import json
import shutil
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np
import tyro

from sglpr_jax.cli.datasets import all_drives, dataset_root, leave_one_out, pack_drives
from sglpr_jax.cli.environment import note_environment
from sglpr_jax.cli.final_test import final_test
from sglpr_jax.cli.learning_curves import draw_learning_curves
from sglpr_jax.cli.presets import load_preset, preset_asked_for, preset_names
from sglpr_jax.cli.runtime import run, stop_on_signal, write_json
from sglpr_jax.cli.training_batches import batches, named_places, positions_of, tuple_pool
from sglpr_jax.cli.training_recall import training_recall
from sglpr_jax.cli.validation import validation_score
from sglpr_jax.data import Drive
from sglpr_jax.data.held_out import hold_out
from sglpr_jax.data.kitti import PoseChoice
from sglpr_jax.data.pseudo_labels import with_pseudo_labels
from sglpr_jax.data.tuples import TuplePool
from sglpr_jax.models.params import graft, load, save
from sglpr_jax.models.sglpr import Params, init
from sglpr_jax.train.config import TrainConfig
from sglpr_jax.train.describe_places import describe_places
from sglpr_jax.train.devices import own_copy
from sglpr_jax.train.hosts import connected, is_first_host, on_all_hosts
from sglpr_jax.train.loop import METRICS_FILE, best_params, train
from sglpr_jax.train.metrics_log import read_metrics
from sglpr_jax.train.mining import FOLDER as MINING
from sglpr_jax.train.mining import DescribeFn, Mining
from sglpr_jax.train.tensorboard import EVENTS, event_writer
from sglpr_jax.train.throughput import throughput

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
      bin/train --hosts 2 --host-index 0 --coordinator 10.0.0.1:1234    one of two hosts; docs/training.md
    """

    seq: str = "08"
    """The drive to test on; it is never trained on."""
    data: Path | None = None
    """The dataset's folder: KITTI's layout, or ready-made BEV images. None: the simulated drives."""
    also: tuple[Path, ...] = ()
    """Further datasets, all of whose drives are trained on, with --also-tuples of a step's tuples: simulated scans or
    images with labels, say, beside real images without."""
    pseudo_labels: Path | None = None
    """Label maps NN/<id>.png that bin/segment made of the images of --data, for its drives without labels of their own;
    never for the one tested."""
    preset: str = "small"
    """A file of configs/ by name, or a path to one of your own."""
    out: Path | None = None
    """The run's folder. None: runs/PRESET-SEQ."""
    resume: bool = False
    """Go on from the run's newest checkpoint."""
    start: str | None = None
    """Weights to begin with, fresh ones where these have none (the segmentation head, say): the name of shipped ones, a
    run's folder, or a folder with config.json and model.safetensors."""
    train_seqs: tuple[str, ...] = ()
    """The drives to train on. Empty: all but the one tested."""
    cache: Path | None = None
    """A folder in which the drives that are trained on are packed, each once, to be read faster; docs/training.md."""
    references: bool = True
    """At the end score untrained weights, the thumbnail and polar-FFT beside it (--no-references: not)."""
    tensorboard: bool = False
    """Write event files for TensorBoard too (extra `tensorboard`)."""
    poses: PoseChoice = "auto"
    """Which poses of KITTI's layout: SemanticKITTI's (sequences/NN/poses.txt) or KITTI's own (poses/NN.txt)."""
    hosts: int = 1
    """How many hosts train together, each started with this same command and its own index."""
    host_index: int = 0
    """Which of them this one is, from 0; the first one writes the run."""
    coordinator: str | None = None
    """HOST:PORT of the first one, any free port, where they meet."""
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
    with connected(hosts=command.hosts, host_index=command.host_index, coordinator=command.coordinator):
        params, test = train_only(command)
    if is_first_host():
        final_test(params, test, folder / "test", seed=command.config.seed, references=command.references)
    return folder


def run_folder(command: TrainCommand) -> Path:
    """Where everything of the run goes."""
    return command.out or Path("runs") / f"{Path(command.preset).stem}-{command.seq}"


def train_only(command: TrainCommand) -> tuple[Params, Drive]:
    """Train, and save the weights; returns them with the drive to test on.

    Exits where it is asked to stop, with what was made saved: with 0 after SIGTERM, with 130 after Ctrl-C.
    """
    folder = run_folder(command)
    config = command.config
    drives, also, test = _drives(command)
    if command.cache is not None:
        cache = command.cache
        drives, also = on_all_hosts(lambda: (pack_drives(drives, cache), pack_drives(also, cache)))
    splits = [hold_out(positions_of(drive), config.validation, config.sampling) for drive in drives]
    pool = tuple_pool(drives, config, frames=[split.training for split in splits])
    mining = None
    if config.sampling.mining == "hardest":
        mining = Mining(_describe_unturned(drives, pool, config), len(pool), config, folder / MINING)
    if config.validation.share:
        score = validation_score(drives, [split.validation for split in splits], config)
    else:
        score = training_recall(drives, pool, config)
    watched = command.tensorboard and is_first_host()
    with event_writer(folder / EVENTS) if watched else contextlib.nullcontext(_ignore) as record:
        on_all_hosts(lambda: is_first_host() and _claim(folder, command, resume=command.resume))
        with stop_on_signal() as stopped:
            state = train(
                config,
                batches(drives, pool, config, also=also, mining=mining),
                folder,
                score=score,
                refresh=mining.refresh if mining else None,
                start_from=_start(command),
                resume=command.resume,
                stopped=stopped,
                places=lambda step: named_places(drives, pool, config, step, mining=mining),
                record=record,
            )
    finished = int(state.step) == config.steps
    best = finished and config.select == "best"
    params = best_params(folder, config) if best else own_copy(state.params)
    if is_first_host():
        save(params, folder / "weights")
        draw_learning_curves(folder)
        _print_throughput(folder, config)
    if not finished:
        print(f"stopped at step {int(state.step)} of {config.steps}; go on with --resume", file=sys.stderr)
        sys.exit(stopped.exit_status)
    return params, test


def _drives(command: TrainCommand) -> tuple[list[Drive], list[Drive], Drive]:
    """The drives to train on, those of --also, and the one to test on. ValueError where one cannot be used."""
    root, config = dataset_root(command.data), command.config
    if command.hosts > 1 and (command.also or config.sampling.mining != "none"):
        raise ValueError(f"mined negatives and --also work on one host only, found --hosts {command.hosts}")
    drives, test = leave_one_out(root, command.seq, train_seqs=command.train_seqs, poses=command.poses)
    also = [drive for folder in command.also for drive in all_drives(folder, poses=command.poses)]
    if any(folder.resolve() == root.resolve() for folder in command.also):
        raise ValueError(f"--also {root}: expected another dataset than the one whose drive {command.seq} is tested")
    if bool(also) != bool(config.also_tuples):
        raise ValueError(
            "--also names datasets and --also-tuples how many tuples of a step are theirs: expected both or neither, "
            f"found {len(command.also)} datasets and {config.also_tuples} tuples"
        )
    if command.pseudo_labels is not None:
        drives = _pseudo_labelled(drives, command.pseudo_labels, config)
    if config.model.categories_read:
        for drive in (*drives, *also, test):
            _require_labels(drive)
    return drives, also, test


def _start(command: TrainCommand) -> Params | None:
    """The weights that a new run begins with, where it is told any."""
    if command.start is None or command.resume:
        return None
    return graft(load(command.start), init(jax.random.key(command.config.seed), config=command.config.model))


def _pseudo_labelled(drives: Sequence[Drive], folder: Path, config: TrainConfig) -> list[Drive]:
    if not config.model.segments:
        raise ValueError("--pseudo-labels are for the segmentation head: expected losses that train one, found none")
    labelled = with_pseudo_labels(drives, folder)
    maps = sum(path is not None for drive in labelled for path in drive.label_paths)
    print(f"{maps} of {sum(map(len, labelled))} images have labels, with those of {folder}", file=sys.stderr)
    return labelled


def _describe_unturned(drives: Sequence[Drive], pool: TuplePool, config: TrainConfig) -> DescribeFn:
    return lambda params, places: describe_places(params, drives, pool, places, np.zeros(len(places)), config)


def _print_throughput(folder: Path, config: TrainConfig) -> None:
    measured = throughput(read_metrics(folder / METRICS_FILE))
    if measured is not None:
        print(
            f"{measured.steps_per_second:.3g} steps/s, {measured.steps_per_second * config.tuples:.3g} tuples/s, "
            f"{measured.data_wait:.1%} of the time waiting for data",
            file=sys.stderr,
        )


def _ignore(step: int, values: Mapping[str, float]) -> None:
    pass


def _claim(folder: Path, command: TrainCommand, *, resume: bool) -> None:
    """Note the effective configuration in the run's folder, or see that a resumed run has the same."""
    path = folder / CONFIG_FILE
    if path.exists() and not resume:
        raise FileExistsError(f"{folder}: there is a run already; go on with --resume, or choose another --out")
    if resume:
        require_same_settings(folder, command)
    folder.mkdir(parents=True, exist_ok=True)
    _sweep(folder)
    write_json(path, _settings(command))
    note_environment(folder, seed=command.config.seed)


def _sweep(folder: Path) -> None:
    """Remove what a process that was killed was writing: files under their temporary names."""
    for left in [*folder.rglob(".*.tmp"), *folder.rglob(".*.png"), *folder.glob(".weights-*")]:
        shutil.rmtree(left) if left.is_dir() else left.unlink()


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
    """The effective configuration as it is written beside the results; on which hosts changes none of them."""
    plain = dataclasses.asdict(dataclasses.replace(command, out=None, resume=False))
    elsewhere = (
        "references",
        "cache",
        "tensorboard",
        "hosts",
        "host_index",
        "coordinator",
    )  # what is tested beside it, how it is read and watched, and made where
    told = {name: value for name, value in plain.items() if name not in elsewhere}
    return json.loads(json.dumps(told, default=str))


def _differences(a: Any, b: Any, prefix: str = "") -> set[str]:
    if not (isinstance(a, dict) and isinstance(b, dict)):
        return set() if a == b else {prefix.removesuffix(".")}
    return {name for key in a.keys() | b.keys() for name in _differences(a.get(key), b.get(key), f"{prefix}{key}.")}


def _require_labels(drive: Drive) -> None:
    labelled = sum(path is not None for path in drive.label_paths)
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
