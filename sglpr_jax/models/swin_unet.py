"""Swin-Unet: an encoder and a decoder of Swin blocks with skip connections, on patches or on circular convolutions.

The stem of the backbone `sglpr` reduces the polar image like the circular CNN, whose result shifts with rotations. A
rotation by a whole number of windows of the coarsest map is a shift of the tokens. Others must be learnt.
"""

import dataclasses
import functools
from collections.abc import Callable

import flax.linen as nn
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sglpr_jax.models.backbone_config import SglprConfig, SwinConfig
from sglpr_jax.models.circular import CircularDecoder, CircularNet
from sglpr_jax.models.layers import BackboneFeatures, LayerNorm, Linear
from sglpr_jax.models.swin import MLP_RATIO, PatchEmbed, PatchExpand, PatchMerging, SwinStage


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

    config: SwinConfig | SglprConfig
    """Widths, depths, heads, window and drop path of the stages."""
    patch: int = 4
    mlp_ratio: int = MLP_RATIO
    circular: bool = False
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
        options = (config.window, self.mlp_ratio, self.circular, self.shift_each_way)
        rates = drop_path_rates(config.depths, config.drop_path)
        stages = [functools.partial(SwinStage, *of, *options) for of in zip(config.heads, rates, strict=True)]
        x = PatchEmbed(config.embed_dim, (self.patch, self.patch), name="patch_embed")(image)
        seen = {"patch_embed": x}
        x = self._encode(x, stages, seen, train)
        x = seen["bottleneck_norm"] = LayerNorm(name="norm")(x)
        x = self._decode(x, stages, seen, train)
        x = seen["norm_up"] = LayerNorm(name="norm_up")(x)
        return x, seen

    def _encode(self, x, stages: list[Callable], seen: dict, train: bool):
        for i, stage in enumerate(stages):
            seen[f"skip{i}"] = x
            x = _run_stage(x, f"encoder_{i}", stage, seen, f"enc{i}", train)
            if i < len(stages) - 1:
                x = PatchMerging(name=f"encoder_{i}_merge")(x)
            seen[f"enc{i}_out"] = x
        return x

    def _decode(self, x, stages: list[Callable], seen: dict, train: bool):
        """Return the map of the last decoder stage for the bottleneck features `x`.

        Decoder stage i has the resolution of encoder stage n - 1 - i and adds the channels of that stage from `seen`.
        Stage 0 only expands the bottleneck.
        """
        for i, level in enumerate(reversed(range(len(stages)))):
            if i > 0:
                x = jnp.concatenate([x, seen[f"skip{level}"]], axis=-1)
                x = Linear(self.config.embed_dim * 2**level, name=f"decoder_{i}_fuse")(x)
                seen[f"dec{i}_concat_linear"] = x
                x = _run_stage(x, f"decoder_{i}", stages[level], seen, f"dec{i}", train)
            if level > 0:
                x = PatchExpand(2, x.shape[-1] // 2, name=f"decoder_{i}_expand")(x)
            seen[f"dec{i}_out"] = x
        return x


def _run_stage(x, name: str, stage: Callable, seen: dict, label: str, train: bool):
    outputs = stage(name=name)(x, train=train)
    seen.update({f"{label}_block{i}": output for i, output in enumerate(outputs)})
    return outputs[-1]


@dataclasses.dataclass(frozen=True)
class SwinBackbone:
    """Swin-Unet on patches of the image: layers `backbone` and `expand`."""

    config: SwinConfig
    circular: bool

    def __call__(self, image: Float[Array, "b p q c"], *, train: bool) -> BackboneFeatures:
        swin_unet = SwinUnet(self.config, self.config.patch, circular=self.circular, name="backbone")
        tokens, named = swin_unet(image, train=train)
        return BackboneFeatures(tokens, [], named)

    def decode(self, seen: BackboneFeatures) -> Float[Array, "b _ _ _"]:
        return PatchExpand(self.config.patch, seen.features.shape[-1], name="expand")(seen.features)


@dataclasses.dataclass(frozen=True)
class SglprBackbone:
    """Swin-Unet with a stem, and a decoder that uses the stem's maps: layers `backbone` and `decoder`."""

    config: SglprConfig

    def __call__(self, image: Float[Array, "b p q c"], *, train: bool) -> BackboneFeatures:
        return CircularSwin(self.config, name="backbone")(image, train=train)

    def decode(self, seen: BackboneFeatures) -> Float[Array, "b _ _ _"]:
        return CircularDecoder(self.config.stem.widths, name="decoder")([*seen.finer, seen.features])


class CircularSwin(nn.Module):
    """Network from the polar image to a token for each pixel of the stem's last map."""

    config: SglprConfig

    @nn.compact
    def __call__(self, polar: Float[Array, "b p q c"], *, train: bool = False) -> BackboneFeatures:
        """Returns the tokens as features. The maps are named as in the circular CNN and the Swin-Unet."""
        config = self.config
        maps = CircularNet(config.stem, name="stem")(polar)
        swin_unet = SwinUnet(config, 1, config.mlp_ratio, circular=True, shift_each_way=True, name="swin_unet")
        tokens, named = swin_unet(maps[-1], train=train)
        return BackboneFeatures(tokens, maps[:-1], {f"circular_block{i}": x for i, x in enumerate(maps[1:])} | named)
