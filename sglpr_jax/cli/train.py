"""bin/train: train on all recordings but one, then test on that one, beside other methods."""

import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from sglpr_jax.cli.recording import report_bad_scan
from sglpr_jax.cli.runtime import (
    StopRequest,
    console,
    own_names,
    parse_command,
    preset_asked_for,
    progress_bar,
    run,
    stop_on_signal,
)
from sglpr_jax.data.choices import PoseChoice, ScanFormat, SensorHeight
from sglpr_jax.methods.names import BESIDE, BesideName
from sglpr_jax.training.config import TrainConfig, without_untrained_head
from sglpr_jax.training.presets import load_preset, preset_names

if TYPE_CHECKING:
    from sglpr_jax.data import Recording
    from sglpr_jax.training.recipe import TrainResult

SETTINGS = ("seq", "data", "also", "pseudo_labels", "preset", "weights", "train_seq", "pose_source")
"""Flags that a resumed run must have the same, beside its configuration."""
SETTINGS_SINCE = ("format", "sensor_height", "skip_bad")
"""Such flags that older runs do not know: noted where they are set."""
GO_ON = "go on with --resume"
"""How a run that was stopped is gone on with."""


@dataclasses.dataclass(frozen=True)
class TrainCommand:
    """Train a model on all recordings of a dataset but one, and test it on that one (leave-one-out).

    Examples:
      bin/train --seq 08                                  on the simulated recordings, preset small
      bin/train --seq 08 --data KITTI --preset paper
      bin/train --seq 08 --data KITTI --resume            goes on where the run was stopped
      bin/train --seq 06 --data IMAGES --also SIMULATED --also-tuples 4     semantics from a second, labelled dataset
      bin/train --seq 08 --optimizer.learning-rate 1e-4   any field of the preset can be set
      bin/train --seq 08 --model.head.cbam False          an ablation; docs/guides/ablations.md has all
      bin/train --hosts 2 --host-index 0 --coordinator 10.0.0.1:1234    one of two hosts; docs/guides/training.md
    """

    seq: str = "08"
    """The recording to test on; it is never trained on."""
    data: Path | None = None
    """The dataset's folder: KITTI's layout, or ready-made BEV images. None: the simulated recordings."""
    also: tuple[Path, ...] = ()
    """Further datasets, all of whose recordings are trained on, with --also-tuples of a step's tuples: simulated scans
    or images with labels, say, beside real images without."""
    pseudo_labels: Path | None = None
    """Label images NN/<id>.png that a model made of the images of --data, for its recordings without labels of
    their own; never for the one tested."""
    preset: str = "small"
    """A file of configs/ by name, or a path to one of your own."""
    out: Path | None = None
    """The run's folder. None: runs/PRESET-SEQ."""
    resume: bool = False
    """Go on from the run's newest checkpoint."""
    weights: str | None = None
    """Weights to begin with, fresh ones where these have none (the segmentation head, say): the name of shipped ones, a
    run's folder, or a folder with config.json and model.safetensors."""
    train_seq: tuple[str, ...] = ()
    """The recordings to train on. Empty: all but the one tested."""
    cache: Path | None = None
    """A folder in which the training recordings are packed, each once, to be read faster; docs/guides/training.md."""
    method: tuple[BesideName, ...] = BESIDE
    """Methods that are scored beside the trained network at the end; `untrained`: this network before training;
    `shipped`: the weights that describe where none are named."""
    tensorboard: bool = False
    """Write event files for TensorBoard too (extra `tensorboard`)."""
    pose_source: PoseChoice = "auto"
    """Which poses of KITTI's layout: SemanticKITTI's (sequences/NN/poses.txt) or KITTI's own (poses/NN.txt)."""
    format: ScanFormat = "auto"
    """What each point of a .bin is, where neither its name nor a look into the files tells."""
    sensor_height: SensorHeight = "auto"
    """How many metres the sensor is above the ground; `estimate` finds it, and the tilt, from the scans, and `auto`
    does where the layout (a plain folder, a bag) does not tell."""
    skip_bad: bool = False
    """Read every scan before the training, report those that cannot be read and train without them."""
    hosts: int = 1
    """How many hosts train together, each started with this same command and its own index."""
    host_index: int = 0
    """Which of them this one is, from 0; the first one writes the run."""
    coordinator: str | None = None
    """HOST:PORT of the first one, any free port, where they meet."""
    config: Annotated[TrainConfig, tyro.conf.arg(name=""), tyro.conf.FlagConversionOff, tyro.conf.AvoidSubcommands] = (
        dataclasses.field(default_factory=TrainConfig)
    )


def parse(arguments: list[str] | None = None) -> TrainCommand:
    """Defaults, overridden by the preset, overridden by the flags."""
    preset = preset_asked_for(arguments, default=TrainCommand.preset)
    description = f"{TrainCommand.__doc__}\nPresets: {', '.join(preset_names())}"
    default = TrainCommand(preset=preset, config=load_preset(preset))
    command = parse_command(TrainCommand, "train", arguments, default=default, description=own_names(description))
    return dataclasses.replace(command, config=without_untrained_head(command.config))


def train_and_test(command: TrainCommand, *, go_on: str = GO_ON) -> Path:
    """Do what the command says; returns the run's folder. `go_on` says how a stopped training can go on."""
    from sglpr_jax.evaluation.final_test import final_test  # these bring JAX and more, which --help does not need
    from sglpr_jax.training.hosts import connected, is_first_host

    folder = run_folder(command)
    with connected(hosts=command.hosts, host_index=command.host_index, coordinator=command.coordinator):
        recordings, also, test = _recordings(command)
        result = _train(command, recordings, also, test, go_on=go_on)
    if is_first_host():
        out, seed = folder / "test", command.config.seed
        found = final_test(result.params, test, out, methods=command.method, seed=seed, progress=progress_bar)
        console().print(found)
        print(f"written to {out}")
    return folder


def run_folder(command: TrainCommand) -> Path:
    """Where everything of the run goes."""
    return command.out or Path("runs") / f"{Path(command.preset).stem}-{command.seq}"


def settings(command: TrainCommand) -> dict[str, object]:
    """What is noted of the flags, beside the configuration."""
    newer = [name for name in SETTINGS_SINCE if getattr(command, name) != getattr(TrainCommand, name)]
    return {name: getattr(command, name) for name in (*SETTINGS, *newer)}


def _train(
    command: TrainCommand,
    recordings: "Sequence[Recording]",
    also: "Sequence[Recording]",
    test: "Recording",
    *,
    go_on: str,
) -> "TrainResult":
    """Train; where that is asked to stop, exit with what was made saved."""
    from sglpr_jax.evaluation.learning_curves import LearningCurves
    from sglpr_jax.training.callbacks import Callbacks
    from sglpr_jax.training.hosts import is_first_host
    from sglpr_jax.training.progress_bar import ProgressBar
    from sglpr_jax.training.recipe import train
    from sglpr_jax.training.tensorboard import EVENTS, EventFiles

    folder = run_folder(command)
    watched = [EventFiles(folder / EVENTS)] if command.tensorboard else []
    with stop_on_signal() as stopped:
        result = train(
            command.config,
            recordings,
            out=folder,
            test=test,
            also=also,
            weights=command.weights,
            resume=command.resume,
            cache=command.cache,
            callback=Callbacks(ProgressBar(), LearningCurves(folder), *watched),
            stopped=stopped,
            settings=settings(command),
        )
    if is_first_host():
        print(result, file=sys.stderr)
    exit_unless_finished(result, stopped, go_on=go_on)
    return result


def exit_unless_finished(result: "TrainResult", stopped: StopRequest, *, go_on: str) -> None:
    """End this process where a training was asked to stop: with 0 after SIGTERM, with 130 after Ctrl-C."""
    if not result.finished:
        print(f"stopped at step {result.steps} of {result.config.steps}; {go_on}", file=sys.stderr)
        sys.exit(stopped.exit_status)


def _recordings(command: TrainCommand) -> "tuple[Sequence[Recording], Sequence[Recording], Recording]":
    """The recordings to train on, those of --also, and the one to test on. ValueError where one cannot be used."""
    from sglpr_jax.cli.datasets import all_recordings, dataset_root, leave_one_out, without_bad_scans

    root = dataset_root(command.data)
    options = {name: getattr(command, name) for name in ("pose_source", "format", "sensor_height")}
    recordings, test = leave_one_out(root, command.seq, train_seqs=command.train_seq, **options)
    also = [recording for folder in command.also for recording in all_recordings(folder, **options)]
    if any(folder.resolve() == root.resolve() for folder in command.also):
        raise ValueError(
            f"--also {root}: expected another dataset than the one whose recording {command.seq} is tested"
        )
    if command.skip_bad:
        *read, test = without_bad_scans([*recordings, *also, test], on_bad_scan=report_bad_scan)
        recordings, also = read[: len(recordings)], read[len(recordings) :]
    if command.pseudo_labels is not None:
        recordings = _pseudo_labelled(recordings, command.pseudo_labels, command.config)
    return recordings, also, test


def _pseudo_labelled(recordings: "Sequence[Recording]", folder: Path, config: TrainConfig) -> "Sequence[Recording]":
    from sglpr_jax.data.pseudo_labels import with_pseudo_labels

    if not config.model.segments:
        raise ValueError("--pseudo-labels are for the segmentation head: expected losses that train one, found none")
    labelled = with_pseudo_labels(recordings, folder)
    images = sum(sum(recording.labelled) for recording in labelled)
    print(f"{images} of {sum(map(len, labelled))} images have labels, with those of {folder}", file=sys.stderr)
    return labelled


def main() -> None:
    """The entry point."""
    run(parse, lambda command: print(f"run: {train_and_test(command)}"))


if __name__ == "__main__":
    main()
