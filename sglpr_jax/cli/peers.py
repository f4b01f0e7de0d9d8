"""bin/peers: train the networks of other publications on your own data, and list them."""

import dataclasses
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro
from rich.table import Table

from sglpr_jax.cli.config_file import record_command
from sglpr_jax.cli.runtime import cache_folder, console, print_error
from sglpr_jax.fields import CountOrZero, NotNegative, Positive
from sglpr_jax.methods.names import LearnedName
from sglpr_jax.progress import progress_bar
from sglpr_jax.stop_request import StopRequest, stop_on_signal

if TYPE_CHECKING:
    from sglpr_jax.methods.learned.method import LearnedMethod
    from sglpr_jax.training.peer_inputs import TrainingInputs
    from sglpr_jax.training.peers import HeldOutScore

RATES = "rates"
"""Folder of the search of the learning rate, in the folder of the run."""


@dataclasses.dataclass(frozen=True)
class PeersCommand:
    """Train the network of another publication from random weights, or list these networks.

    A run can be interrupted with Ctrl-C or SIGTERM and continued with --resume. bin/embed describes recordings with the
    weights in its folder.

    Example:
      bin/peers list
      bin/peers train rinet KITTI --out runs/rinet --seconds 3600
      bin/peers train rinet TOWNS KITTI --out runs/rinet --held-out HELD_OUT
      bin/peers train rinet KITTI --out runs/rinet --resume
    """

    action: tyro.conf.Positional[Literal["train", "list"]]
    """`train` trains METHOD on all recordings of DATA. `list` prints the methods."""
    method: tyro.conf.Positional[LearnedName | None] = None
    """Method to train."""
    data: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Datasets in any supported layout. All their recordings are trained on."""
    out: Path | None = None
    """Folder of the run."""
    seconds: NotNegative = 3600.0
    """Training time in seconds. Scores and the compilation of the step do not count."""
    images: CountOrZero = 0
    """Number of images after which the training stops, if the time is not over before; 0: no limit."""
    seed: CountOrZero = 0
    """Seed of the weights, the tuples and the rotations."""
    learning_rate: Positive | None = None
    """Learning rate. None: the best of three short trainings with --held-out, otherwise the published rate."""
    held_out: Path | None = None
    """Dataset with revisits that is not trained on. The learning rates and the snapshots are scored on it."""
    search_seconds: Positive = 300.0
    """Training time of each learning rate of the search, in seconds."""
    cache: Path | None = None
    """Folder for the prepared inputs. None: the user's cache."""
    resume: bool = False
    """Continue the run in --out."""


def run_peers(command: PeersCommand) -> None:
    """Run the command. If the training is asked to stop, saves its state and exits."""
    from sglpr_jax.methods.learned import LEARNED  # slow imports, not needed for --help
    from sglpr_jax.training.peers import RunSettings, train_learned

    if command.action == "list":
        table = Table("method", "publication", "licence", "input", "weights")
        for method in LEARNED.values():
            table.add_row(method.name, method.source, method.licence, method.takes, f"{method.weights:,}")
        console().print(table)
        return
    if command.method is None or not command.data or command.out is None:
        raise ValueError("expected bin/peers train METHOD DATA... --out RUN, found no METHOD, DATA or --out")
    method, out = LEARNED[command.method], command.out
    resume = _has_run(out, resume=command.resume)
    data, score = _training_inputs(command, method)
    with stop_on_signal() as stopped:
        rate = _learning_rate(command, method, data, score, out, stopped)
        settings = RunSettings(rate, seed=command.seed, seconds=command.seconds, images=command.images)
        options = {"stopped": stopped, "report": print_error, "progress": progress_bar, "resume": resume}
        run = train_learned(method, data, settings, out, score=score, **options)
        record_command(dataclasses.replace(command, learning_rate=rate), out)
    print(f"{out}: {run.images} images in {run.seconds:.0f} s", file=sys.stderr)
    if stopped():
        stopped.exit("stopped; continue with --resume")
    print(f"run: {out}")


def _has_run(out: Path, *, resume: bool) -> bool:
    """Return whether the folder has a training. A stopped search of the learning rate does not count.

    Raises FileExistsError for a training without `resume`, and FileNotFoundError if there is nothing to resume.
    """
    has_run = (out / "config.json").exists()
    if has_run and not resume:
        raise FileExistsError(f"{out}: there is a run already; resume it (--resume) or choose another --out")
    if resume and not has_run and not (out / RATES).is_dir():
        raise FileNotFoundError(f"{out}: expected a run to resume, found none")
    return has_run


def _training_inputs(command: PeersCommand, method: "LearnedMethod") -> "tuple[TrainingInputs, HeldOutScore | None]":
    """Prepare the training recordings. Also returns the score on the recordings of --held-out, or None without them."""
    from sglpr_jax.cli.datasets import all_recordings
    from sglpr_jax.data.fingerprint import fingerprint
    from sglpr_jax.training.peer_inputs import prepare_inputs
    from sglpr_jax.training.peers import HeldOutScore
    from sglpr_jax.training.validation import require_revisits

    cache = command.cache or cache_folder() / "peers"
    recordings = [recording for root in command.data for recording in all_recordings(root, title="training on")]
    if command.held_out is None:
        return prepare_inputs(method, recordings, cache, progress=progress_bar), None
    held_out = all_recordings(command.held_out, title="held out")
    trained_on = set(map(fingerprint, recordings))
    if same := [recording.name for recording in held_out if fingerprint(recording) in trained_on]:
        raise ValueError(f"--held-out {command.held_out}: expected recordings not in DATA, found {same[0]} in both")
    require_revisits(held_out)
    held_out_inputs = prepare_inputs(method, held_out, cache, progress=progress_bar)
    return prepare_inputs(method, recordings, cache, progress=progress_bar), HeldOutScore(method, held_out_inputs)


def _learning_rate(
    command: PeersCommand,
    method: "LearnedMethod",
    data: "TrainingInputs",
    score: "HeldOutScore | None",
    out: Path,
    stopped: StopRequest,
) -> float:
    """Return --learning-rate, or else the best rate of a search if there is a score, or else the published rate."""
    from sglpr_jax.training.peers import Stopped, best_rate

    if command.learning_rate is not None:
        return command.learning_rate
    if score is None:
        return method.recipe.learning_rates[1]  # the published one
    options = {"stopped": stopped, "report": print_error, "progress": progress_bar}
    try:
        return best_rate(method, data, score, out / RATES, seconds=command.search_seconds, seed=command.seed, **options)
    except Stopped:
        stopped.exit("stopped; continue with --resume")
