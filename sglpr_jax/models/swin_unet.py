"""Swin-Unet: an encoder and a decoder of Swin blocks with skip connections, on patches or on circular convolutions.

On circular convolutions, a rotation of the scan by whole windows of the coarsest map only shifts the tokens.
"""

import flax.linen as nn
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sglpr_jax.models.backbone_config import SglprConfig, SwinConfig
from sglpr_jax.models.circular import CircularNet
from sglpr_jax.models.layers import LayerNorm, Linear
from sglpr_jax.models.swin import PatchEmbed, PatchExpand, PatchMerging, SwinStage


def drop_path_rates(depths: tuple[int, ...], rate: float) -> list[tuple[float, ...]]:
    """Return the rates of stochastic depth of the blocks of each stage. They rise linearly from 0 to `rate`."""
    rates = np.linspace(0, rate, sum(depths))
    first_blocks = np.cumsum(depths)[:-1]
    return [tuple(stage_rates.tolist()) for stage_rates in np.split(rates, first_blocks)]


class SwinUnet(nn.Module):
    """Network from the image to one token per patch, before the last expansion to pixels.

    Encoder stage i has embed_dim * 2**i channels. Of n stages, decoder stage i has the resolution, blocks and heads of
    encoder stage n - 1 - i, whose input joins its own input (skip connection).
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
        config = self.config
        maps = {}
        stages = len(config.depths)
        drop_paths = drop_path_rates(config.depths, config.drop_path)

        def run_stage(x: Array, level: int, layer_name: str, map_name: str) -> Array:
            """Run a new stage with the heads and depth of encoder stage `level`, and store the maps of its blocks."""
            stage = SwinStage(
                config.heads[level],
                drop_paths[level],
                window=config.window,
                mlp_ratio=config.mlp_ratio,
                circular=self.circular,
                shift_each_way=self.shift_each_way,
                name=layer_name,
            )
            outputs = stage(x, train=train)
            maps.update({f"{map_name}_block{i}": output for i, output in enumerate(outputs)})
            return outputs[-1]

        x = maps["patch_embed"] = PatchEmbed(config.embed_dim, (self.patch, self.patch), name="patch_embed")(image)
        for i in range(stages):
            maps[f"skip{i}"] = x
            x = run_stage(x, i, f"encoder_{i}", f"enc{i}")
            if i < stages - 1:
                x = PatchMerging(name=f"encoder_{i}_merge")(x)
            maps[f"enc{i}_out"] = x
        x = maps["bottleneck_norm"] = LayerNorm(name="norm")(x)
        for i, level in enumerate(reversed(range(stages))):
            if i > 0:  # decoder stage 0 has no blocks and only expands the bottleneck
                x = jnp.concatenate([x, maps[f"skip{level}"]], axis=-1)
                x = maps[f"dec{i}_concat_linear"] = Linear(config.embed_dim * 2**level, name=f"decoder_{i}_fuse")(x)
                x = run_stage(x, level, f"decoder_{i}", f"dec{i}")
            if level > 0:
                x = PatchExpand(2, x.shape[-1] // 2, name=f"decoder_{i}_expand")(x)
            maps[f"dec{i}_out"] = x
        x = maps["norm_up"] = LayerNorm(name="norm_up")(x)
        return x, maps


class CircularSwin(nn.Module):
    """Swin-Unet on the last map of a circular CNN (the stem). Each pixel of this map becomes a token."""

    config: SglprConfig

    @nn.compact
    def __call__(
        self, polar: Float[Array, "b p q c"], *, train: bool = False
    ) -> tuple[list[Float[Array, "b _ _ _"]], dict[str, Float[Array, "b _ _ _"]]]:
        """Return the maps of the stem with the tokens in place of the last map, and all intermediate maps by name."""
        stem_maps = CircularNet(self.config.stem, name="stem")(polar)
        named_stem_maps = {f"circular_block{i}": block for i, block in enumerate(stem_maps[1:])}
        if not self.config.depths:
            return stem_maps, named_stem_maps
        swin_unet = SwinUnet(self.config, patch=1, circular=True, shift_each_way=True, name="swin_unet")
        tokens, swin_maps = swin_unet(stem_maps[-1], train=train)
        return [*stem_maps[:-1], tokens], named_stem_maps | swin_maps
