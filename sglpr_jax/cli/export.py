"""bin/export: weights to hand out, without what only training needs."""

import dataclasses
from pathlib import Path

import tyro

from sglpr_jax.bev import ImageKind
from sglpr_jax.cli.runtime import run
from sglpr_jax.models.params import WEIGHTS_FILE, for_places, load, save
from sglpr_jax.models.sglpr import Params


@dataclasses.dataclass(frozen=True)
class ExportCommand:
    """Write weights to hand out: what describes places, without the segmentation head.

    Example: bin/export --weights runs/small-08 --out mine --half
    """

    weights: str
    """The name of shipped weights, a training run's folder, or one with config.json and model.safetensors."""
    out: Path
    """The folder to write; there must be none yet."""
    half: bool = False
    """Store float16 numbers, in half the room; they are read as float32."""
    keep_segmentation: bool = False
    """Keep the segmentation head, for bin/segment."""
    image: ImageKind | None = None
    """What raw scans are made into, where config.json says something else: `density` for weights that were trained on
    ready-made density images."""


def export(command: ExportCommand) -> Path:
    """Do what the command says; returns the folder written. Raises FileExistsError where there is one."""
    if command.out.exists():
        raise FileExistsError(f"{command.out}: expected a folder that does not exist yet, found one")
    params = load(command.weights)
    params = params if command.keep_segmentation else for_places(params)
    if command.image is not None:
        params = Params(params.weights, dataclasses.replace(params.config, image=command.image))
    save(params, command.out, half=command.half)
    print(f"{command.out}: {(command.out / WEIGHTS_FILE).stat().st_size / 1e6:.1f} MB of weights")
    return command.out


def main() -> None:
    """The entry point."""
    run(lambda: export(tyro.cli(ExportCommand, prog="export")))


if __name__ == "__main__":
    main()
