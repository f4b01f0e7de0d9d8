"""bin/export: write weights, or a program that contains them, without the parts that only training needs."""

import dataclasses
from pathlib import Path
from typing import Literal

from sglpr_jax.fields import NotNegative
from sglpr_jax.models.config import WHITENING_POWER
from sglpr_jax.models.shipped import DEFAULT_WEIGHTS
from sglpr_jax.progress import progress_bar


@dataclasses.dataclass(frozen=True)
class ExportCommand:
    """Write the weights that descriptors need, without the segmentation head, or a program that contains them.

    Example:
      bin/export --weights runs/sglpr-08 --out mine --half
      bin/export --whiten my_scans/ --out mine      for your own sensor, without labels or poses
      bin/export --format onnx --out mine           for other runtimes
      bin/export --weights runs/b --average runs/a --shares 0.6 0.4 --out mine
    """

    out: Path
    """Output folder. It must not exist."""
    weights: str = DEFAULT_WEIGHTS
    """Name of shipped weights, folder of a training run, or folder with config.json and model.safetensors."""
    average: tuple[str, ...] = ()
    """Further weights of the same model. Each parameter is averaged over all models, and the whitening layer is
    removed. All trainings must descend from one training."""
    shares: tuple[NotNegative, ...] = ()
    """Weight of each model in the mean, --weights first. If omitted, all are equal."""
    format: Literal["weights", "stablehlo", "onnx"] = "weights"
    """`weights` is for this package. `stablehlo` (read by jax.export) and `onnx` are programs that compute descriptors
    from images. They contain the weights and run without this package."""
    half: bool = False
    """Store float16 numbers, which take half the space. They are read as float32."""
    keep_segmentation: bool = False
    """Keep the segmentation head, for semantic maps."""
    image: Literal["points", "density"] | None = None
    """Image made of raw scans, if config.json has the wrong value: `density` for weights trained on ready-made density
    images."""
    whiten: tuple[Path, ...] = ()
    """Datasets or folders of scans. A last layer is fitted to the descriptors of these scans. It evens out the spread
    of descriptors over all directions. It replaces an existing whitening layer."""
    whiten_power: NotNegative = WHITENING_POWER
    """Exponent of the whitening: each principal component is divided by this power of its spread. 1 evens out all
    components."""


def export(command: ExportCommand) -> None:
    """Run the command. Raises FileExistsError if the output folder exists."""
    from sglpr_jax.data.readers import open_recording, recording_names
    from sglpr_jax.models.export import save_program
    from sglpr_jax.models.weights import Params, average, for_places
    from sglpr_jax.models.weights_file import load, save
    from sglpr_jax.retrieval.embed import whiten

    if command.out.exists():
        raise FileExistsError(f"{command.out}: expected a folder that does not exist yet, found one")
    if command.format != "weights" and (command.half or command.keep_segmentation):
        flag = "half" if command.half else "keep-segmentation"
        raise ValueError(f"expected --{flag} only with --format weights, found it with {command.format}")
    if command.shares and not command.average:
        raise ValueError("expected --shares only with --average, found it without")
    models = [load(name) for name in (command.weights, *command.average)]
    models = models if command.keep_segmentation else [for_places(model) for model in models]
    params = average(models, shares=command.shares or None) if command.average else models[0]
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
