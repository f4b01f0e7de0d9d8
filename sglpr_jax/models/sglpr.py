"""SG-LPR whole (figure 2): shared Swin-Unet features, the place head, and the segmentation head of training time."""

from collections.abc import Callable
from typing import Any, NamedTuple

import flax.linen as nn
import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sglpr_jax.bev import Grid
from sglpr_jax.labels import UNLABELLED
from sglpr_jax.models.config import ModelConfig
from sglpr_jax.models.detail import Detail
from sglpr_jax.models.layers import Linear, torch_uniform
from sglpr_jax.models.place_head import PlaceHead
from sglpr_jax.models.polar import from_polar, to_polar
from sglpr_jax.models.presets import model_preset
from sglpr_jax.models.raw_place import RawPlace
from sglpr_jax.models.ring_net import RingDecoder, RingNet
from sglpr_jax.models.stem import Stem, StemDecoder
from sglpr_jax.models.swin import FinalPatchExpand
from sglpr_jax.models.swin_unet import SwinUnet

CLIP_COUNT = 10.0


@flax.struct.dataclass
class Params:
    """Weights together with the model they belong to: a pytree whose static part is `config`."""

    weights: Any
    config: ModelConfig = flax.struct.field(pytree_node=False)


class Outputs(NamedTuple):
    """What one pass gives: descriptors (b, 256), logits (b, h, w, classes) if asked for, and every named map."""

    descriptor: Array
    logits: Any
    intermediates: dict[str, Array]


class SGLPR(nn.Module):
    """The network on prepared images. A pure function of (weights, image): no part of it sees the rest of the batch."""

    config: ModelConfig

    @nn.compact
    def __call__(self, image: Float[Array, "b h w c"], *, segment: int = 0, train: bool = False) -> Outputs:
        """`segment` n: semantic logits of every n-th image (True: of all); 0: that head does not exist."""
        config, seen, circular = self.config, image, self.config.polar is not None
        if config.polar:
            seen = to_polar(image, config.grid, *config.polar)
        seen = seen.astype(config.compute)
        tokens, maps, intermediates = self._backbone(seen, train)
        expand = self._expansion()
        reads_pixels = config.head.tap == "pixels"
        features = expand(tokens, maps) if reads_pixels else tokens
        descriptor, head = PlaceHead(config.head, circular, name="place_head")(features)
        logits = None
        if segment:
            pixels = (
                features[::segment] if reads_pixels else expand(*jax.tree.map(lambda x: x[::segment], (tokens, maps)))
            )
            intermediates["pixels"] = pixels
            logits = self._logits(pixels, image[::segment])
        return Outputs(descriptor, logits, intermediates | head)

    def _backbone(self, seen: Float[Array, "b p q c"], train: bool) -> tuple[Array, list[Array], dict[str, Array]]:
        """Features, the maps on the way that the segmentation head looks at again, and every named map."""
        config, circular = self.config, self.config.polar is not None
        if config.rings:
            maps = RingNet(config.rings, name="rings")(seen)
            return maps[-1], maps, {f"ring_block{i}": seen for i, seen in enumerate(maps[1:])}
        maps = Stem(config.stem, circular, name="stem")(seen) if config.stem else []
        tokens, intermediates = SwinUnet(
            embed_dim=config.embed_dim,
            depths=config.depths,
            heads=config.heads,
            window=config.window,
            mlp_ratio=config.mlp_ratio,
            patch=config.token_pixels,
            drop_path=config.drop_path,
            circular=circular,
            name="backbone",
        )(maps[-1] if maps else seen, train=train)
        return tokens, maps, intermediates

    def _expansion(self) -> Callable[[Array, list[Array]], Array]:
        """From tokens to pixels: a linear layer, or past the maps of the stem."""
        config = self.config
        if config.rings:
            decoder = RingDecoder(name="decoder")
            return lambda _, maps: decoder(maps)
        if config.stem:
            return StemDecoder(config.token_pixels, config.polar is not None, name="decoder")
        expand = FinalPatchExpand(config.patch, name="expand")
        return lambda tokens, _: expand(tokens)

    def _logits(self, pixels: Float[Array, "b p q c"], image: Float[Array, "b h w i"]) -> Float[Array, "b h w k"]:
        """The segmentation head. Few channels cross from the polar image to the grid: a linear layer comes first.

        The logits, and what is resampled, are float32.
        """
        config = self.config
        to_logits = Linear(config.classes, use_bias=False, kernel_init=torch_uniform, name="segmentation_head")
        crossing = Linear(config.detail, name="narrow")(pixels) if config.detail else to_logits(pixels)
        on_grid = crossing.astype(jnp.float32)
        on_grid = from_polar(on_grid, config.grid) if config.polar else on_grid
        if not config.detail:
            return on_grid
        detailed = Detail(config.detail, name="detail")(on_grid.astype(config.compute), image)
        return to_logits(detailed).astype(jnp.float32)


def prepare(
    bev: Float[Array, "b h w"] | Int[Array, "b h w"], config: ModelConfig
) -> Float[Array, "b h w {config.channels}"]:
    """Point counts as network input: rescaled as `config.counts` says, blank where it does not see."""
    image = jnp.asarray(bev, jnp.float32)
    if config.counts == "log1p":
        image = jnp.log1p(image)
    elif config.counts == "clipped":
        image = jnp.minimum(image, CLIP_COUNT) / CLIP_COUNT
    image = jnp.where(field_of_view(config), image, 0.0)[..., None]
    if config.range_channel:
        distance = cell_distance(config.grid) / cell_distance(config.grid).max()
        image = jnp.concatenate([image, jnp.broadcast_to(distance[None, ..., None], image.shape)], axis=-1)
    return image


def field_of_view(config: ModelConfig) -> Bool[np.ndarray, "1 h w"]:
    """Which cells the network sees: all, or those inside the largest circle, but not those of the vehicle itself."""
    grid, distance = config.grid, cell_distance(config.grid)
    seen = (distance < grid.resolution_m * min(grid.height, grid.width) / 2) | (config.field == "square")
    return (seen & (distance >= config.blind_m))[None]


def cell_distance(grid: Grid) -> Float[np.ndarray, "h w"]:
    """How far the middle of each cell lies from the sensor, metres."""
    down, right = np.mgrid[: grid.height, : grid.width]
    cells = np.hypot(down - (grid.height - 1) / 2, right - (grid.width - 1) / 2)
    return (grid.resolution_m * cells).astype(np.float32)


@jax.jit
def describe(
    params: Params,
    bev: Float[Array, "*b h w"] | Int[Array, "*b h w"],
    labels: Int[Array, "... h w"] | None = None,
) -> Float[Array, "*b d"]:
    """The descriptor of each bird's-eye-view image of point counts: 256 numbers of unit length.

    Any leading axes; works under jit, vmap and grad; computes nothing of the segmentation head. The distance between
    two descriptors is the dissimilarity of their places (equation 2). A head that reads labels (`head.input`) needs the
    maps of classes too. Raises ValueError for images of another size than `params.config.grid`, and for labels that are
    missing or that nothing reads.
    """
    return forward(params, bev, labels, segment=0).descriptor.reshape(*bev.shape[:-2], -1)


def segment(params: Params, bev: Float[Array, "*b h w"] | Int[Array, "*b h w"]) -> Float[Array, "*b h w k"]:
    """The semantic logits of each image, from the head that training uses. Raises ValueError where there is none."""
    if not params.config.segments:
        raise ValueError("expected a model with a segmentation head, found one without: it was made for places alone")
    return forward(params, bev).logits.reshape(*bev.shape, -1)


def forward(
    params: Params,
    bev: Float[Array, "*b h w"] | Int[Array, "*b h w"],
    labels: Int[Array, "... h w"] | None = None,
    *,
    key: Array | None = None,
    segment: int = 1,
) -> Outputs:
    """Everything at once, for training and pictures: descriptors, logits and named maps, leading axes made one.

    With a `key` it is the training pass, in which stochastic depth drops residual branches. `segment` n gives the
    logits of every n-th image; with 0 the segmentation head does not exist, and a model without one gives none. Raises
    ValueError as `describe` does.
    """
    config = params.config
    grid = config.grid
    if bev.ndim < 2 or bev.shape[-2:] != (grid.height, grid.width):
        raise ValueError(f"expected images [..., H, W] of {grid.height} x {grid.width} cells, found shape {bev.shape}")
    _check_labels(labels, bev.shape, config)
    image = prepare(bev.reshape(-1, grid.height, grid.width), config)
    if labels is not None:
        labels = jnp.where(field_of_view(config), labels.reshape(image.shape[:-1]), UNLABELLED)
    variables = {"params": params.weights}
    outputs: Any
    if config.head.input != "features":
        outputs = RawPlace(config).apply(variables, image, labels)
        return Outputs(outputs[0], None, outputs[1])
    train, rngs = key is not None, None if key is None else {"drop_path": key}
    outputs = SGLPR(config).apply(variables, image, segment=config.segments and segment, train=train, rngs=rngs)
    return outputs


def _check_labels(labels: Array | None, shape: tuple[int, ...], config: ModelConfig) -> None:
    """Labels must be there exactly where the head reads them."""
    found = "none" if labels is None else f"shape {labels.shape}"
    if config.head.reads_labels and (labels is None or labels.shape != shape):
        raise ValueError(
            f"this model describes a place from {config.head.input}: expected maps of classes of shape {shape}, "
            f"one for each image, found {found}"
        )
    if labels is not None and not config.head.reads_labels:
        raise ValueError(f"this model describes a place from {config.head.input}: expected no labels, found {found}")


def init(key: Array, *, preset: str = "small", config: ModelConfig | None = None) -> Params:
    """Fresh weights for a named preset, or for a `config` of your own; only those that it needs."""
    config = model_preset(preset) if config is None else config
    image = jnp.zeros((1, config.grid.height, config.grid.width, config.channels))
    if config.head.input != "features":
        weights = jax.jit(RawPlace(config).init)(key, image, jnp.zeros(image.shape[:-1], jnp.int32))["params"]
    else:
        make = jax.jit(SGLPR(config).init, static_argnames="segment")
        weights = make(key, image, segment=config.segments)["params"]
    return Params(weights, config)
