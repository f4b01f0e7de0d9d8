"""bin/demo: the whole job in minutes: simulate, train, embed, evaluate."""

import dataclasses
import shutil
import sys
from pathlib import Path

from sglpr_jax.cli.embed import EmbedCommand, embed_recording
from sglpr_jax.cli.evaluate import EvaluateCommand, evaluate_file
from sglpr_jax.cli.recording import PosedRecordingOptions
from sglpr_jax.cli.runtime import own_names, parse_command, run
from sglpr_jax.methods.names import SHIPPED, UNTRAINED
from sglpr_jax.models.shipped import DEFAULT_WEIGHTS

SCANS = 300
AZIMUTH_STEPS = 450
TESTED = "00"
PRESET = "demo"
WEIGHTS = DEFAULT_WEIGHTS
BESIDE = (SHIPPED, UNTRAINED, "thumbnail", "polar-fft")


@dataclasses.dataclass(frozen=True)
class DemoCommand:
    """Go on training the shipped weights on two simulated recordings; find the loop closures of a third, never seen.

    The third is 00, which comes back to its places in the same direction. The shipped weights as they are, and methods
    that need no training, are scored beside the trained ones.
    """

    out: Path = Path("runs/demo")
    """Folder for everything; an earlier demo's run in it is replaced, its simulated recordings are kept."""
    scans: int = SCANS
    """Scans of each recording."""
    steps: int | None = None
    """Training steps. None: the preset's."""


def demo(command: DemoCommand) -> Path:
    """Do what the command says; returns its folder."""
    from sglpr_jax.cli.datasets import simulate  # these bring JAX and more, which --help does not need
    from sglpr_jax.cli.train import TrainCommand, train_and_test
    from sglpr_jax.evaluation.page.writing import PAGE
    from sglpr_jax.training.presets import load_preset

    town, trained = command.out / "town", command.out / "run"
    simulate(town, scans=command.scans, azimuth_steps=AZIMUTH_STEPS, seed=0)
    if trained.exists():
        shutil.rmtree(trained)
    config = load_preset(PRESET)
    config = config if command.steps is None else dataclasses.replace(config, steps=command.steps)
    train_and_test(
        TrainCommand(seq=TESTED, data=town, preset=PRESET, weights=WEIGHTS, method=BESIDE, out=trained, config=config),
        go_on="the demo begins its training anew",
    )
    print(own_names("\nthe same by hand: bin/embed, then bin/evaluate"), file=sys.stderr)
    source, weights = PosedRecordingOptions(seq=TESTED), str(trained)
    file = command.out / f"{TESTED}.npz"
    embed_recording(EmbedCommand(data=town, source=source, weights=weights, out=file))
    evaluate_file(EvaluateCommand(file, data=town, source=source, weights=weights))
    pictures = sorted([*trained.glob("test/*.png"), *(command.out / TESTED).glob("*.png")])
    print("pictures:", *pictures, sep="\n  ")
    print(f"all on one page: {command.out / TESTED / PAGE}")
    return command.out


def main() -> None:
    """The entry point."""
    run(lambda: parse_command(DemoCommand, "demo"), demo)


if __name__ == "__main__":
    main()
