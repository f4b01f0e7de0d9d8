"""bin/convert: weights of the published Swin-Unet or Swin-T, to begin a training with."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

import tyro

from sglpr_jax.cli.runtime import parse_command, run


@dataclasses.dataclass(frozen=True)
class ConvertCommand:
    """Write weights that begin with those of a published network, for `bin/train --weights`; the rest is fresh.

    Examples:
      bin/convert swin_tiny_patch4_window7_224.safetensors --out start
      bin/convert swin_unet.safetensors --network swin-unet --preset mine.py --out start
    """

    checkpoint: Annotated[Path, tyro.conf.Positional]
    """A .safetensors file with the network's weights by PyTorch's names. A .pth is a pickle and must be converted first
    (docs/guides/weights.md)."""
    out: Path
    """The folder to write; there must be none yet."""
    network: Literal["swin-t", "swin-unet"] = "swin-t"
    """What the file holds: ImageNet's Swin-T, whose blocks fill encoder and decoder as far as they fit, or a whole
    Swin-Unet, which must fit."""
    preset: str = "paper"
    """The model to fill, a preset or a .py file of your own; its backbone must be `swin`."""
    seed: int = 0
    """Of the weights that the file has none for."""


def convert(command: ConvertCommand) -> Path:
    """Do what the command says; returns the folder written. Raises FileExistsError where there is one."""
    import jax  # these bring JAX and more, which --help does not need

    from sglpr_jax.models.sglpr import init
    from sglpr_jax.models.torch_import import import_swin_t, import_swin_unet
    from sglpr_jax.models.weights import by_name
    from sglpr_jax.models.weights_file import save
    from sglpr_jax.training.presets import load_preset

    if command.out.exists():
        raise FileExistsError(f"{command.out}: expected a folder that does not exist yet, found one")
    fresh = init(jax.random.key(command.seed), config=load_preset(command.preset).model)
    if command.network == "swin-t":
        params, copied, _, unused = import_swin_t(fresh, command.checkpoint)
    else:
        params, unused = import_swin_unet(fresh, command.checkpoint), ()
        copied = tuple(name for name in by_name(params.weights) if not name.startswith("place_head/"))
    save(params, command.out)
    share = _share({name: leaf.size for name, leaf in by_name(params.weights).items()}, copied)
    print(f"{command.out}: {share} of {command.checkpoint.name}, the rest fresh (seed {command.seed})")
    if unused:
        print(f"without a place in {command.preset}: {', '.join(unused[:5])}{', ...' if len(unused) > 5 else ''}")
    return command.out


def _share(sizes: dict[str, int], copied: tuple[str, ...]) -> str:
    """How many of the numbers were taken over, in words; `sizes` are those of all weights."""
    taken, whole = sum(sizes[name] for name in copied), sum(sizes.values())
    return f"{taken / 1e6:.1f} of {whole / 1e6:.1f} million numbers ({taken / whole:.0%})"


def main() -> None:
    """The entry point."""
    run(lambda: parse_command(ConvertCommand, "convert"), convert)


if __name__ == "__main__":
    main()
