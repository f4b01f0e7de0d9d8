"""bin/train: train on all recordings but one, and test on that one, beside other methods."""

import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from sglpr_jax.cli.recording import report_bad_scan
from sglpr_jax.cli.runtime import console, with_installed_names
from sglpr_jax.data.choices import PoseChoice, ScanFormat, SensorHeight
from sglpr_jax.files import check_still_there, file_name
from sglpr_jax.methods.names import BESIDE, BesideName
from sglpr_jax.progress import progress_bar
from sglpr_jax.stop_request import StopRequest, stop_on_signal
from sglpr_jax.training.config import TrainConfig, without_untrained_head

if TYPE_CHECKING:
    from sglpr_jax.data.recording import Recording
    from sglpr_jax.training.recipe import TrainResult

SETTINGS = ("seq", "data", "also", "pseudo_labels", "preset", "weights", "train_seq", "pose_source", "format",
            "sensor_height", "skip_bad")  # fmt: skip
"""Flags that must be equal in a resumed run, beside its configuration."""


@dataclasses.dataclass(frozen=True)
class TrainCommand:
    """Train a model on all recordings but one, and test it on that one (leave-one-out).

    Example:
      bin/train --seq 08                                  on the simulated recordings, preset sglpr
      bin/train --seq 08 --data KITTI --preset paper
      bin/train --seq 08 --data KITTI --resume            resumes a stopped run
      bin/train --seq friday --data monday tuesday.bag friday    own scans, with poses beside them; no labels needed
      bin/train --seq 06 --data IMAGES --also SIMULATED --also-tuples 4     semantics from a second, labelled dataset
      bin/train --seq 08 --optimizer.learning-rate 1e-4   any field of the preset can be set
      bin/train --seq 08 --model.head.cbam False          an ablation; docs/guides/reproduce.md lists all
      bin/train --preset paper --hosts 2 --host-index 0 --coordinator 10.0.0.1:1234   docs/guides/training.md
    """

    seq: str = "08"
    """Recording to test on. It is never trained on."""
    data: Path | tuple[Path, ...] | None = None
    """Dataset, bag or folder of scans, or several of them, in any supported layout. None: the simulated recordings."""
    also: tuple[Path, ...] = ()
    """Further datasets, which provide --also-tuples tuples of each step. All their recordings are trained on. They
    can add labelled simulated images to real images without labels."""
    pseudo_labels: Path | None = None
    """Folder of label images NN/<id>.png that a model predicted for the images of --data. They are added to training
    recordings of images without labels. The tested recording never uses them."""
    preset: str = "sglpr"
    """Name of a file in configs/, or path of your own file."""
    out: Path | None = None
    """Folder of the run. None: runs/PRESET-SEQ."""
    resume: bool = False
    """Continue from the newest checkpoint of the run."""
    weights: str | None = None
    """Initial weights: name of shipped weights, folder of a run, or folder with config.json and model.safetensors.
    Missing weights, such as those of a segmentation head, are random."""
    train_seq: tuple[str, ...] = ()
    """Recordings to train on. If omitted, all except the tested one."""
    cache: Path | None = None
    """Folder in which each training recording is packed on first use, for faster reading (docs/guides/training.md)."""
    method: tuple[BesideName, ...] = BESIDE
    """Methods that are scored beside the trained network at the end. `untrained` is this network with random weights;
    `shipped` are the default weights."""
    tensorboard: bool = False
    """Also write event files for TensorBoard (extra `tensorboard`)."""
    pose_source: PoseChoice = "auto"
    """Pose files of KITTI's layout: SemanticKITTI's (sequences/NN/poses.txt) or KITTI's own (poses/NN.txt)."""
    format: ScanFormat = "auto"
    """Point format of .bin files. `auto` detects it from the names or the content of the files."""
    sensor_height: SensorHeight = "auto"
    """Height of the sensor above the ground, in metres. `estimate` estimates the height and the tilt from the scans.
    `auto` estimates them only if the layout (a plain folder, a bag) does not define them."""
    skip_bad: bool = False
    """Read every scan before the training, report unreadable ones and train without them."""
    hosts: int = 1
    """Number of hosts that train together. Each host runs this command with its own index."""
    host_index: int = 0
    """Index of this host, from 0. The first host writes the run."""
    coordinator: str | None = None
    """Address of the first host, HOST:PORT, with any free port."""
    config: Annotated[TrainConfig, tyro.conf.arg(name=""), tyro.conf.FlagConversionOff, tyro.conf.AvoidSubcommands] = (
        dataclasses.field(default_factory=TrainConfig)
    )


def train_and_test(command: TrainCommand) -> None:
    """Run the command. If a signal stops the training, exit."""
    from sglpr_jax.evaluation.final_test import final_test  # slow imports, not needed for --help
    from sglpr_jax.training.devices import connected, is_first_host
    from sglpr_jax.training.run_folder import CONFIG_FILE

    folder = run_folder(command)
    with connected(hosts=command.hosts, host_index=command.host_index, coordinator=command.coordinator):
        recordings, also, test = open_recordings(command)
        result = _train(command, recordings, also, test)
    if is_first_host():
        out, seed = folder / "test", command.config.seed
        console().print(final_test(result.params, test, out, methods=command.method, seed=seed, progress=progress_bar))
        check_still_there(folder / CONFIG_FILE)
        print(f"written to {out}")
    print(f"run: {folder}")
    print(with_installed_names(f"next: bin/loops my_scans --weights {folder}"), file=sys.stderr)


def run_folder(command: TrainCommand) -> Path:
    """Return the folder of the run."""
    return command.out or Path("runs") / f"{Path(command.preset).stem}-{file_name(command.seq)}"


def settings(command: TrainCommand) -> dict[str, object]:
    """Return the flags that the run stores in config.json beside its configuration, by name."""
    return {name: getattr(command, name) for name in SETTINGS}


def _train(
    command: TrainCommand, recordings: "Sequence[Recording]", also: "Sequence[Recording]", test: "Recording"
) -> "TrainResult":
    """Train with the flags of the command. If a signal stops the training, save its state and exit."""
    from sglpr_jax.evaluation.learning_curves import LearningCurves
    from sglpr_jax.training.callbacks import EVENTS, Callbacks, EventFiles, ProgressBar
    from sglpr_jax.training.devices import is_first_host
    from sglpr_jax.training.recipe import PackingStopped, train

    folder = run_folder(command)
    event_files = [EventFiles(folder / EVENTS)] if command.tensorboard else []
    with stop_on_signal() as stopped:
        try:
            result = train(
                command.config,
                recordings,
                out=folder,
                test=test,
                also=also,
                weights=command.weights,
                resume=command.resume,
                cache=command.cache,
                callback=Callbacks(ProgressBar(), LearningCurves(folder), *event_files),
                stopped=stopped,
                settings=settings(command),
            )
        except PackingStopped as stop:
            stopped.exit(f"{stop}; run the same command again to continue")
    if is_first_host():
        print(result, file=sys.stderr)
    exit_unless_finished(result, stopped, stop_advice="continue with --resume")
    return result


def exit_unless_finished(result: "TrainResult", stopped: StopRequest, *, stop_advice: str) -> None:
    """Exit if a signal stopped the training before its last step: with status 0 after SIGTERM, 130 after Ctrl-C."""
    if not result.finished:
        stopped.exit(f"stopped at step {result.steps} of {result.config.steps}; {stop_advice}")


def open_recordings(command: TrainCommand) -> "tuple[Sequence[Recording], Sequence[Recording], Recording]":
    """Open the training recordings, those of --also, and the test recording.

    Raises ValueError if --also has the tested recording, or if the test recording lacks what a method needs.
    """
    from sglpr_jax.cli.datasets import all_recordings, dataset_root, leave_one_out, without_bad_scans
    from sglpr_jax.data.fingerprint import fingerprint
    from sglpr_jax.data.scan_stream import require_content
    from sglpr_jax.methods.handcrafted import HANDCRAFTED

    roots = command.data if isinstance(command.data, tuple) else (dataset_root(command.data),)
    if not roots:
        raise ValueError("--data: expected a dataset, found none")
    options = {name: getattr(command, name) for name in ("pose_source", "format", "sensor_height")}
    recordings, test = leave_one_out(roots, command.seq, train_seqs=command.train_seq, **options)
    also = [recording for folder in command.also for recording in all_recordings(folder, **options)]
    if also and fingerprint(test) in map(fingerprint, also):
        raise ValueError(f"--also: expected datasets without the tested recording {command.seq}, found it in one")
    if command.skip_bad:
        *readable, test = without_bad_scans([*recordings, *also, test], on_bad_scan=report_bad_scan)
        recordings, also = readable[: len(recordings)], readable[len(recordings) :]
    for name in command.method:
        if name in HANDCRAFTED:
            require_content(name, HANDCRAFTED[name].takes, test, every_label=True)
    if command.pseudo_labels is not None:
        recordings = _add_pseudo_labels(recordings, command.pseudo_labels, without_untrained_head(command.config))
    return recordings, also, test


def _add_pseudo_labels(recordings: "Sequence[Recording]", folder: Path, config: TrainConfig) -> "Sequence[Recording]":
    """Return the recordings with the label images of the folder. Raises ValueError if no loss would use them."""
    from sglpr_jax.data.training_recordings import with_pseudo_labels

    if not config.model.segments:
        raise ValueError(
            "--pseudo-labels train the segmentation head: expected a model with one and losses for it, found none"
        )
    labelled = with_pseudo_labels(recordings, folder)
    images = sum(sum(recording.labelled) for recording in labelled)
    print(f"{images} of {sum(map(len, labelled))} images have labels, including those of {folder}", file=sys.stderr)
    return labelled
