"""bin/demo: simulate a town, find loops with the shipped weights, and show a short training."""

import dataclasses
import shutil
import sys
from pathlib import Path

from sglpr_jax.cli.embed import EmbedCommand, embed_recording
from sglpr_jax.cli.evaluate import EvaluateCommand, evaluate_file
from sglpr_jax.cli.loops import LoopsCommand, loops_of_recording
from sglpr_jax.cli.recording import PosedRecordingOptions
from sglpr_jax.cli.runtime import with_installed_names
from sglpr_jax.methods.names import SHIPPED, UNTRAINED
from sglpr_jax.models.shipped import DEFAULT_WEIGHTS

SCANS = 300
AZIMUTH_STEPS = 450
STEPS = 20
"""Training steps."""
TESTED = "00"
"""Recording whose loops are searched. It is not trained on."""
PRESET = "sglpr-small"
WEIGHTS = DEFAULT_WEIGHTS
COMPARED_METHODS = (UNTRAINED, SHIPPED)


@dataclasses.dataclass(frozen=True)
class DemoCommand:
    """Find the loops of a simulated recording with the shipped weights, score their descriptors, and train briefly.

    The training shows the command at work on two other recordings. It is far too short to reach the shipped weights.
    """

    out: Path = Path("runs/demo")
    """Output folder. The training run of an earlier demo is replaced. The simulated recordings of an earlier demo are
    kept."""
    scans: int = SCANS
    """Scans of each recording."""


def demo(command: DemoCommand) -> None:
    from sglpr_jax.cli.datasets import simulate  # slow imports, not needed for --help
    from sglpr_jax.cli.train import TrainCommand, train_and_test
    from sglpr_jax.evaluation.evaluation_page import PAGE
    from sglpr_jax.evaluation.loops_page import PAGE as LOOPS_PAGE
    from sglpr_jax.training.presets import load_preset

    out, town = command.out, command.out / "town"
    simulate(town, scans=command.scans, azimuth_steps=AZIMUTH_STEPS, seed=0)
    source = PosedRecordingOptions(seq=TESTED)

    _print_title(f"loops of recording {TESTED}: bin/loops")
    loops_of_recording(LoopsCommand(town, source=source, weights=WEIGHTS, out=out / "loops"))
    _print_title("its descriptors and their score: bin/embed, bin/evaluate")
    file = out / f"{TESTED}.npz"
    embed_recording(EmbedCommand(data=town, source=source, weights=WEIGHTS, out=str(file)))
    evaluate_file(EvaluateCommand(file, data=town, source=source, weights=WEIGHTS))
    _print_title(f"{STEPS} steps of training, to show the command; thousands would be needed: bin/train")
    if (out / "run").exists():
        shutil.rmtree(out / "run")
    config = dataclasses.replace(load_preset(PRESET), steps=STEPS, score_every=STEPS)
    train = TrainCommand(seq=TESTED, data=town, preset=PRESET, method=COMPARED_METHODS, out=out / "run", config=config)
    train_and_test(train, stop_advice="the next demo restarts its training")
    print(f"\npages: {out / 'loops' / LOOPS_PAGE}, {out / TESTED / PAGE}")


def _print_title(text: str) -> None:
    print(with_installed_names(f"\n{text}"), file=sys.stderr)
