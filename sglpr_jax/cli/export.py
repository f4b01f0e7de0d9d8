"""bin/export: weights to hand out, without what only training needs."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from sglpr_jax.cli.runtime import parse_command, progress_bar, run
from sglpr_jax.fields import NotNegative
from sglpr_jax.models.config import WHITENING_POWER
from sglpr_jax.models.shipped import DEFAULT_WEIGHTS

if TYPE_CHECKING:
    from sglpr_jax.models.params import Params


@dataclasses.dataclass(frozen=True)
class ExportCommand:
    """Write weights to hand out: what describes places, without the segmentation head; or a program with them inside.

    Examples:
      bin/export --weights runs/small-08 --out mine --half
      bin/export --whiten my_scans/ --out mine      for one's own sensor, without labels or poses
      bin/export --format onnx --out mine           for other runtimes
      bin/export --weights runs/b --average runs/a --shares 0.6 0.4 --out mine
    """

    out: Path
    """The folder to write; there must be none yet."""
    weights: str = DEFAULT_WEIGHTS
    """The name of shipped weights, a training run's folder, or one with config.json and model.safetensors."""
    average: tuple[str, ...] = ()
    """More weights of the same model, of trainings of which one began with another's: every parameter becomes the mean
    of all, without a whitening layer."""
    shares: tuple[NotNegative, ...] = ()
    """How much each counts in that mean, those of --weights first; (): all alike."""
    format: Literal["weights", "stablehlo", "onnx"] = "weights"
    """`weights` for this package. `stablehlo` (what jax.export reads) and `onnx` are programs that make descriptors of
    images, with the weights inside, for runtimes that do not know this package."""
    half: bool = False
    """Store float16 numbers, in half the room; they are read as float32."""
    keep_segmentation: bool = False
    """Keep the segmentation head, for semantic maps."""
    image: Literal["points", "density"] | None = None
    """What raw scans are made into, where config.json says something else: `density` for weights that were trained on
    ready-made density images."""
    whiten: tuple[Path, ...] = ()
    """Datasets or folders of scans; to their descriptors a last layer is fitted that evens out the spread over the
    directions (models/whitening.py), in place of one that is there."""
    whiten_power: NotNegative = WHITENING_POWER
    """By which power of its spread a principal component is divided: 1 evens out all."""


def export(command: ExportCommand) -> Path:
    """Do what the command says; returns the folder written. Raises FileExistsError where there is one."""
    from sglpr_jax.data import open_recording, recording_names  # these bring JAX and more, which --help does not need
    from sglpr_jax.models.params import Params
    from sglpr_jax.models.program import save_program
    from sglpr_jax.models.weights_file import save
    from sglpr_jax.retrieval.whiten import whiten

    if command.out.exists():
        raise FileExistsError(f"{command.out}: expected a folder that does not exist yet, found one")
    if command.format != "weights" and (command.half or command.keep_segmentation):
        flag = "half" if command.half else "keep-segmentation"
        raise ValueError(f"expected --{flag} with --format weights alone, found it with {command.format}")
    params = _load(command)
    if command.image is not None:
        params = Params(params.weights, dataclasses.replace(params.config, image=command.image))
    if command.whiten:
        recordings = [open_recording(folder, name) for folder in command.whiten for name in recording_names(folder)]
        with progress_bar("embed", max(map(len, recordings))) as show:
            params = whiten(params, recordings, power=command.whiten_power, on_progress=show)
    if command.format == "weights":
        save(params, command.out, half=command.half)
    else:
        save_program(params, command.out, format=command.format)
    size = sum(file.stat().st_size for file in command.out.iterdir())
    print(f"{command.out}: {size / 1e6:.1f} MB of {'weights' if command.format == 'weights' else command.format}")
    return command.out


def _load(command: ExportCommand) -> "Params":
    """The weights, or the average of several, with the segmentation head where it is kept."""
    from sglpr_jax.models.average import average
    from sglpr_jax.models.weights import for_places
    from sglpr_jax.models.weights_file import load

    if command.shares and not command.average:
        raise ValueError("expected --shares with --average alone, found it without")
    models = [load(name) for name in (command.weights, *command.average)]
    models = models if command.keep_segmentation else [for_places(model) for model in models]
    return average(models, shares=command.shares or None) if command.average else models[0]


def main() -> None:
    """The entry point."""
    run(lambda: parse_command(ExportCommand, "export"), export)


if __name__ == "__main__":
    main()
