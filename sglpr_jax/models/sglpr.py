"""SG-LPR whole (figure 2): a shared backbone, the place head, and the segmentation head of training time."""

from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Num

from sglpr_jax.labels import UNLABELLED
from sglpr_jax.models.backbones.build import build
from sglpr_jax.models.backbones.interface import Backbone, Seen
from sglpr_jax.models.config import ModelConfig
from sglpr_jax.models.heads.place import PlaceHead
from sglpr_jax.models.heads.raw_input import raw_input
from sglpr_jax.models.heads.segmentation import segmentation_head
from sglpr_jax.models.input_image import FEWEST_CELLS, backbone_view, field_of_view, prepare
from sglpr_jax.models.params import Params
from sglpr_jax.models.presets import model_preset


class Outputs(NamedTuple):
    """What one pass gives: descriptors, logits where asked for, and every map on the way."""

    descriptor: Float[Array, "b d"]
    """Of length 1; 256 numbers in the paper."""
    logits: Any
    """(b, h, w, classes), or None where they were not asked for or the model has no segmentation head."""
    intermediates: dict[str, Array]
    """Every map by name."""


class SGLPR(nn.Module):
    """The network on prepared images. A pure function of (weights, image): no part of it sees the rest of the batch."""

    config: ModelConfig

    @nn.compact
    def __call__(
        self,
        image: Float[Array, "b h w c"],
        labels: Int[Array, "b h w"] | None = None,
        *,
        segment: int = 1,
        train: bool = False,
    ) -> Outputs:
        """`segment` n: semantic logits of every n-th image, where there is such a head; 0: of none.

        `labels` are for a place head that reads them, which stands alone: it has no backbone (table 6).
        """
        config = self.config
        place_head = PlaceHead(config.head, circular=config.polar is not None, name="place_head")
        if not config.head.reads_features:
            features = raw_input(image, labels, config)
            descriptor, maps = place_head(features)
            return Outputs(descriptor, None, {"raw_input": features, **maps})
        backbone = build(config.backbone, circular=config.polar is not None)
        seen = backbone(backbone_view(image, config), train=train)
        pixels = backbone.decode(seen) if config.head.tap == "pixels" else None
        descriptor, maps = place_head(seen.features if pixels is None else pixels)
        maps = {**seen.named, **maps}
        if not (segment and config.segments):
            return Outputs(descriptor, None, maps)
        pixels = _decode_every(segment, backbone, seen) if pixels is None else pixels[::segment]
        logits = segmentation_head(pixels, image[::segment], config)
        return Outputs(descriptor, logits, {**maps, "pixels": pixels})


def _decode_every(n: int, backbone: Backbone, seen: Seen) -> Float[Array, "b p q c"]:
    """The pixels of every n-th image."""
    finer = [one[::n] for one in seen.finer]
    return backbone.decode(Seen(seen.features[::n], finer, named={}))


@jax.jit
def describe(
    params: Params,
    bev: Num[Array, "*b h w"],
    labels: Int[Array, "... h w"] | None = None,
) -> Float[Array, "*b d"]:
    """The descriptor of each bird's-eye-view image, as `scan_image` makes it: 256 numbers of unit length.

    The weights that ship want density images (`params.config.image`); `rasterize` makes images for models that want
    counts of points. Any leading axes; works under jit, vmap and grad; computes nothing of the segmentation head. The
    distance between two descriptors is the dissimilarity of their places (equation 2). A head that reads labels
    (`head.input`) needs the maps of classes too. A density image is float counts 0 to 10, or the uint8 grey values 0 to
    255 of its file. Raises ValueError for images of another size than `params.config.grid`, for density images of other
    integers, and for labels that are missing or that nothing reads. An empty image has a descriptor too: see
    `is_describable`.
    """
    if 0 in bev.shape[:-2]:
        return jnp.zeros((*bev.shape[:-2], params.config.head.descriptor_size))
    return forward(params, bev, labels, segment=0).descriptor.reshape(*bev.shape[:-2], -1)


@jax.jit
def is_describable(params: Params, bev: Num[Array, "*b h w"]) -> Bool[Array, "*b"]:
    """Whether each image shows something where the model looks: finite counts, and at least 2 cells that hold points.

    The flag beside `describe`, which gives every empty image the same descriptor. Works under jit and vmap.
    """
    seen = jnp.where(field_of_view(params.config)[0], bev > 0, False)
    enough = seen.sum((-2, -1), dtype=jnp.int32) >= FEWEST_CELLS
    return enough & jnp.isfinite(bev).all((-2, -1))


def segment(params: Params, bev: Num[Array, "*b h w"]) -> Float[Array, "*b h w k"]:
    """The semantic logits of each image, from the head that training uses. Raises ValueError where there is none."""
    if not params.config.segments:
        raise ValueError("expected a model with a segmentation head, found one without: it was made for places alone")
    return forward(params, bev).logits.reshape(*bev.shape, -1)


def forward(
    params: Params,
    bev: Num[Array, "*b h w"],
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
    if 0 in bev.shape:
        raise ValueError(f"expected at least one image, found shape {bev.shape}")
    _check_labels(labels, bev.shape, config)
    image = prepare(bev.reshape(-1, grid.height, grid.width), config)
    if labels is not None:
        labels = jnp.where(field_of_view(config), labels.reshape(image.shape[:-1]), UNLABELLED)
    outputs: Any = SGLPR(config).apply(
        {"params": params.weights},
        image,
        labels,
        segment=segment,
        train=key is not None,
        rngs=None if key is None else {"drop_path": key},
    )
    return outputs


def _check_labels(labels: Array | None, shape: tuple[Any, ...], config: ModelConfig) -> None:
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
    labels = jnp.zeros(image.shape[:-1], jnp.int32) if config.head.reads_labels else None
    return Params(jax.jit(SGLPR(config).init)(key, image, labels)["params"], config)
