"""bin/demo: simulate, train, embed and evaluate in minutes."""

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
    """Fine-tune the shipped weights on two simulated recordings, and find the revisits of a third one that is held out.

    The third recording is 00, whose revisits have the same direction. The unchanged shipped weights and methods without
    training are scored for comparison.
    """

    out: Path = Path("runs/demo")
    """Output folder. The training run of an earlier demo is replaced; its simulated recordings are kept."""
    scans: int = SCANS
    """Scans of each recording."""
    steps: int | None = None
    """Training steps. None: the preset's."""


def demo(command: DemoCommand) -> Path:
    """Run the command. Returns the output folder."""
    from sglpr_jax.cli.datasets import simulate  # slow imports, not needed for --help
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
        go_on="the next demo restarts its training",
    )
    print(own_names("\nthe same with two commands: bin/embed, then bin/evaluate"), file=sys.stderr)
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
