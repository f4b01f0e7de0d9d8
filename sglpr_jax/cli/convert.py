"""bin/convert: convert the weights of a published Swin-Unet or Swin-T to initial weights of a training run."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

import tyro


@dataclasses.dataclass(frozen=True)
class ConvertCommand:
    """Write initial weights for `bin/train --weights`, taken from a published network. Weights that the file does not
    contain are random.

    Example:
      bin/convert swin_tiny_patch4_window7_224.safetensors --out start
      bin/convert swin_unet.safetensors --network swin-unet --preset mine.py --out start
    """

    checkpoint: Annotated[Path, tyro.conf.Positional]
    """A .safetensors file with the network's weights under PyTorch's names. A .pth file is a pickle and must be
    converted first (docs/guides/weights.md)."""
    out: Path
    """Output folder. It must not exist."""
    network: Literal["swin-t", "swin-unet"] = "swin-t"
    """Network in the file. `swin-t` is ImageNet's Swin-T, whose blocks fill encoder and decoder where they fit.
    `swin-unet` is a whole Swin-Unet, which must match."""
    preset: str = "paper"
    """Model to fill: a preset or your own .py file. Its backbone must be `swin`."""
    seed: int = 0
    """Seed of the weights that the file does not contain."""


def convert(command: ConvertCommand) -> None:
    """Run the command. Raises FileExistsError if the output folder exists."""
    import jax  # slow imports, not needed for --help

    from sglpr_jax.models.sglpr import init
    from sglpr_jax.models.torch_import import import_swin_t, import_swin_unet
    from sglpr_jax.models.weights import by_name
    from sglpr_jax.models.weights_file import save
    from sglpr_jax.training.presets import load_preset

    if command.out.exists():
        raise FileExistsError(f"{command.out}: expected a folder that does not exist yet, found one")
    random_params = init(jax.random.key(command.seed), config=load_preset(command.preset).model)
    if command.network == "swin-t":
        params, copied, unused = import_swin_t(random_params, command.checkpoint)
    else:
        params, unused = import_swin_unet(random_params, command.checkpoint), ()
        copied = tuple(name for name in by_name(params.weights) if not name.startswith("place_head/"))
    save(params, command.out)
    sizes = {name: leaf.size for name, leaf in by_name(params.weights).items()}
    copied_size, total_size = sum(sizes[name] for name in copied), sum(sizes.values())
    share = f"{copied_size / 1e6:.1f} of {total_size / 1e6:.1f} million numbers ({copied_size / total_size:.0%})"
    print(f"{command.out}: {share} of {command.checkpoint.name}, the rest random (seed {command.seed})")
    if unused:
        print(f"not used by {command.preset}: {', '.join(unused[:5])}{', ...' if len(unused) > 5 else ''}")
