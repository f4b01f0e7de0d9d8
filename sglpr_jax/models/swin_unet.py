"""Swin-Unet: an encoder and a decoder of Swin blocks with skip connections."""

import dataclasses

import flax.linen as nn
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sglpr_jax.models.backbone import Seen
from sglpr_jax.models.config import SwinConfig
from sglpr_jax.models.layers import LayerNorm, Linear
from sglpr_jax.models.swin import MLP_RATIO, FinalPatchExpand, PatchEmbed, PatchExpand, PatchMerging, SwinStage


def drop_path_rates(depths: tuple[int, ...], rate: float) -> list[tuple[float, ...]]:
    """Return the rates of stochastic depth for each encoder stage, from 0 in the first block to `rate` in the last."""
    rates = np.linspace(0, rate, sum(depths))
    ends = np.cumsum(depths)
    return [tuple(rates[end - depth : end].tolist()) for depth, end in zip(depths, ends, strict=True)]


class SwinUnet(nn.Module):
    """Network from the image to one token per patch, before the last expansion to pixels.

    Stage i has embed_dim * 2**i channels. The decoder mirrors the encoder, including its depths, heads and drop path.
    With `circular`, the left and right borders of the image are neighbours, as in a polar image.
    """

    embed_dim: int
    depths: tuple[int, ...]
    heads: tuple[int, ...]
    window: int
    mlp_ratio: int = MLP_RATIO
    patch: int = 4
    drop_path: float = 0.0
    circular: bool = False
    shift_each_way: bool = False
    """Whether windows that span the map in one direction are still shifted in the other."""

    @nn.compact
    def __call__(
        self, image: Float[Array, "b h w c"], *, train: bool = False
    ) -> tuple[Float[Array, "b h//{self.patch} w//{self.patch} {self.embed_dim}"], dict[str, Float[Array, "b _ _ _"]]]:
        """Return the tokens, and the intermediate maps by name: `enc0_block1`, `bottleneck_norm`, `dec2_out`, ..."""
        stages = [
            {
                "heads": heads,
                "window": self.window,
                "mlp_ratio": self.mlp_ratio,
                "drop_paths": rates,
                "circular": self.circular,
                "shift_each_way": self.shift_each_way,
            }
            for heads, rates in zip(self.heads, drop_path_rates(self.depths, self.drop_path), strict=True)
        ]
        x = PatchEmbed(self.embed_dim, (self.patch, self.patch), name="patch_embed")(image)
        seen = {"patch_embed": x}
        x = self._encode(x, stages, seen, train)
        x = seen["bottleneck_norm"] = LayerNorm(name="norm")(x)
        x = self._decode(x, stages, seen, train)
        x = seen["norm_up"] = LayerNorm(name="norm_up")(x)
        return x, seen

    def _encode(self, x, stages: list[dict], seen: dict, train: bool):
        for i, stage in enumerate(stages):
            seen[f"skip{i}"] = x
            x = _run_stage(x, f"encoder_{i}", stage, seen, f"enc{i}", train)
            if i < len(stages) - 1:
                x = PatchMerging(name=f"encoder_{i}_merge")(x)
            seen[f"enc{i}_out"] = x
        return x

    def _decode(self, x, stages: list[dict], seen: dict, train: bool):
        """Return the map of the last decoder stage for the bottleneck features `x`.

        Decoder stage i has the resolution of encoder stage n - 1 - i and adds the channels of that stage from `seen`.
        Stage 0 only expands the bottleneck.
        """
        for i, level in enumerate(reversed(range(len(stages)))):
            if i > 0:
                x = jnp.concatenate([x, seen[f"skip{level}"]], axis=-1)
                x = Linear(self.embed_dim * 2**level, name=f"decoder_{i}_fuse")(x)
                seen[f"dec{i}_concat_linear"] = x
                x = _run_stage(x, f"decoder_{i}", stages[level], seen, f"dec{i}", train)
            if level > 0:
                x = PatchExpand(name=f"decoder_{i}_expand")(x)
            seen[f"dec{i}_out"] = x
        return x


def _run_stage(x, name: str, stage: dict, seen: dict, label: str, train: bool):
    outputs = SwinStage(**stage, name=name)(x, train=train)
    seen.update({f"{label}_block{i}": output for i, output in enumerate(outputs)})
    return outputs[-1]


@dataclasses.dataclass(frozen=True)
class SwinBackbone:
    """Swin-Unet on patches of the image: layers `backbone` and `expand`."""

    config: SwinConfig
    circular: bool

    def __call__(self, image: Float[Array, "b p q c"], *, train: bool) -> Seen:
        """Computes the tokens."""
        config = self.config
        swin_unet = SwinUnet(
            embed_dim=config.embed_dim,
            depths=config.depths,
            heads=config.heads,
            window=config.window,
            patch=config.patch,
            drop_path=config.drop_path,
            circular=self.circular,
            name="backbone",
        )
        tokens, named = swin_unet(image, train=train)
        return Seen(tokens, [], named)

    def decode(self, seen: Seen) -> Float[Array, "b _ _ _"]:
        """Computes a pixel for each pixel of the image by a linear layer."""
        return FinalPatchExpand(self.config.patch, name="expand")(seen.features)
