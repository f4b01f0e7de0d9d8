"""Swin-Unet: an encoder and a decoder of Swin blocks with skip connections, on patches or on circular convolutions.

The stem of the backbone `sglpr` reduces the polar image like the circular CNN, whose result shifts with rotations. A
rotation by a whole number of windows of the coarsest map is a shift of the tokens. Others must be learnt.
"""

import functools

import flax.linen as nn
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sglpr_jax.models.backbone_config import SglprConfig, SwinConfig
from sglpr_jax.models.circular import CircularNet
from sglpr_jax.models.layers import LayerNorm, Linear
from sglpr_jax.models.swin import PatchEmbed, PatchExpand, PatchMerging, SwinStage


def drop_path_rates(depths: tuple[int, ...], rate: float) -> list[tuple[float, ...]]:
    """Return the rates of stochastic depth for each encoder stage, from 0 in the first block to `rate` in the last."""
    rates = np.linspace(0, rate, sum(depths))
    ends = np.cumsum(depths)
    return [tuple(rates[end - depth : end].tolist()) for depth, end in zip(depths, ends, strict=True)]


class SwinUnet(nn.Module):
    """Network from the image to one token per patch, before the last expansion to pixels.

    Encoder stage i has embed_dim * 2**i channels. The decoder mirrors the encoder, including its depths, heads and drop
    path: decoder stage i has the resolution of encoder stage n - 1 - i, whose input joins it (skip connection).
    """

    config: SwinConfig | SglprConfig
    patch: int = 4
    """Edge of a token's patch, in pixels of the image."""
    circular: bool = False
    """Whether the left and right borders of the image are neighbours, as in a polar image."""
    shift_each_way: bool = False
    """Whether windows that span the map in one direction are still shifted in the other."""

    @nn.compact
    def __call__(
        self, image: Float[Array, "b h w c"], *, train: bool = False
    ) -> tuple[
        Float[Array, "b h//{self.patch} w//{self.patch} {self.config.embed_dim}"], dict[str, Float[Array, "b _ _ _"]]
    ]:
        """Return the tokens, and the intermediate maps by name: `enc0_block1`, `bottleneck_norm`, `dec2_out`, ..."""
        config, maps = self.config, {}
        options = (config.window, config.mlp_ratio, self.circular, self.shift_each_way)
        stage_rates = drop_path_rates(config.depths, config.drop_path)
        stages = [
            functools.partial(SwinStage, heads, rates, *options)
            for heads, rates in zip(config.heads, stage_rates, strict=True)
        ]

        def run_stage(x: Array, level: int, name: str, label: str) -> Array:
            """Run the blocks of a stage with the widths of encoder stage `level`, and store their maps."""
            outputs = stages[level](name=name)(x, train=train)
            maps.update({f"{label}_block{i}": output for i, output in enumerate(outputs)})
            return outputs[-1]

        x = maps["patch_embed"] = PatchEmbed(config.embed_dim, (self.patch, self.patch), name="patch_embed")(image)
        for i in range(len(stages)):
            maps[f"skip{i}"] = x
            x = run_stage(x, i, f"encoder_{i}", f"enc{i}")
            if i < len(stages) - 1:
                x = PatchMerging(name=f"encoder_{i}_merge")(x)
            maps[f"enc{i}_out"] = x
        x = maps["bottleneck_norm"] = LayerNorm(name="norm")(x)
        for i, level in enumerate(reversed(range(len(stages)))):
            if i > 0:  # decoder stage 0 only expands the bottleneck
                x = jnp.concatenate([x, maps[f"skip{level}"]], axis=-1)
                x = maps[f"dec{i}_concat_linear"] = Linear(config.embed_dim * 2**level, name=f"decoder_{i}_fuse")(x)
                x = run_stage(x, level, f"decoder_{i}", f"dec{i}")
            if level > 0:
                x = PatchExpand(2, x.shape[-1] // 2, name=f"decoder_{i}_expand")(x)
            maps[f"dec{i}_out"] = x
        x = maps["norm_up"] = LayerNorm(name="norm_up")(x)
        return x, maps


class CircularSwin(nn.Module):
    """Network from the polar image to a token for each pixel of the stem's last map."""

    config: SglprConfig

    @nn.compact
    def __call__(
        self, polar: Float[Array, "b p q c"], *, train: bool = False
    ) -> tuple[list[Float[Array, "b _ _ _"]], dict[str, Float[Array, "b _ _ _"]]]:
        """Return the maps of the stem, of which the tokens replace the last one, and all maps by name."""
        maps = CircularNet(self.config.stem, name="stem")(polar)
        swin_unet = SwinUnet(self.config, patch=1, circular=True, shift_each_way=True, name="swin_unet")
        tokens, named = swin_unet(maps[-1], train=train)
        return [*maps[:-1], tokens], {f"circular_block{i}": block for i, block in enumerate(maps[1:])} | named
