"""The network, and the calls that users make: `describe`, `segment`, `forward`, `is_describable` and `init`."""

from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Num

from sglpr_jax.labels import UNLABELLED
from sglpr_jax.models.backbone_config import BackboneConfig, CircularConfig, SglprConfig, SwinConfig
from sglpr_jax.models.circular import CircularBackbone
from sglpr_jax.models.config import ModelConfig, model_preset
from sglpr_jax.models.initial import draw_all
from sglpr_jax.models.input_image import FEWEST_CELLS, backbone_view, field_of_view, prepare
from sglpr_jax.models.layers import BackboneFeatures
from sglpr_jax.models.params import Params
from sglpr_jax.models.place_head import PlaceHead, raw_input
from sglpr_jax.models.segmentation_head import segmentation_head
from sglpr_jax.models.swin_unet import SglprBackbone, SwinBackbone


def _backbone(config: BackboneConfig, *, circular: bool) -> SwinBackbone | CircularBackbone | SglprBackbone:
    """Return the layers of a backbone, which belong to the calling Flax module.

    They have two calls: from images to `BackboneFeatures`, and from these to pixels (`decode`, at most once).
    """
    match config:
        case SwinConfig():
            return SwinBackbone(config, circular)
        case CircularConfig():
            return CircularBackbone(config)
        case SglprConfig():
            return SglprBackbone(config)


class Outputs(NamedTuple):
    """Outputs of one forward pass."""

    descriptor: Float[Array, "b d"]
    """Descriptors of length 1, with 256 numbers in the paper."""
    logits: Any
    """(b, h, w, classes), or None if no logits were requested or the model has no segmentation head."""
    intermediates: dict[str, Array]
    """Every intermediate map by name."""


class SGLPR(nn.Module):
    """Network on prepared images: a pure function of weights and image, independent of the rest of the batch."""

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
        """Compute descriptors and semantic logits.

        Logits are computed for every `segment`-th image, or for no image if it is 0 or if there is no segmentation
        head. `labels` are for a place head that reads labels. This head has no backbone (table 6).
        """
        config = self.config
        place_head = PlaceHead(config.head, circular=config.polar is not None, name="place_head")
        if not config.head.reads_features:
            features = raw_input(image, labels, config)
            descriptor, maps = place_head(features)
            return Outputs(descriptor, None, {"raw_input": features, **maps})
        backbone = _backbone(config.backbone, circular=config.polar is not None)
        seen = backbone(backbone_view(image, config), train=train)
        pixels = backbone.decode(seen) if config.head.tap == "pixels" else None
        descriptor, maps = place_head(seen.features if pixels is None else pixels)
        maps = {**seen.named, **maps}
        if not (segment and config.segments):
            return Outputs(descriptor, None, maps)
        if pixels is None:
            pixels = backbone.decode(
                BackboneFeatures(seen.features[::segment], [one[::segment] for one in seen.finer], {})
            )
        else:
            pixels = pixels[::segment]
        logits = segmentation_head(pixels, image[::segment], config)
        return Outputs(descriptor, logits, {**maps, "pixels": pixels})


@jax.jit
def describe(
    params: Params,
    bev: Num[Array, "*b h w"],
    labels: Int[Array, "... h w"] | None = None,
) -> Float[Array, "*b d"]:
    """Compute the descriptor of each bird's-eye-view image. It works under jit, vmap and grad.

    The distance between two descriptors is the dissimilarity of their places (equation 2). An empty image has a
    descriptor, too: see `is_describable`.

    Arguments:
      params: Model. The shipped weights require density images (`params.config.image`).
      bev: Images with any leading axes, from `scan_image`. A density image has float counts from 0 to 10, or the uint8
        grey values from 0 to 255 of its file.
      labels: Class maps, if the head reads labels (`head.input`).

    Returns:
      Descriptors of length 1. The shipped weights give 256 numbers.

    Raises:
      TypeError: If the images are not an array, for instance a list.
      ValueError: If the images have another size than `params.config.grid`, if a density image has another integer
        type, if labels are missing, or if the head does not read labels.
    """
    _check_array(bev)
    if 0 in bev.shape[:-2]:
        return jnp.zeros((*bev.shape[:-2], params.config.head.descriptor_size))
    return forward(params, bev, labels, segment=0).descriptor.reshape(*bev.shape[:-2], -1)


@jax.jit
def is_describable(params: Params, bev: Num[Array, "*b h w"]) -> Bool[Array, "*b"]:
    """Whether each image shows a place: all counts are finite, and at least 2 cells in the field of view hold points.

    `describe` gives every empty image the same descriptor. The function works under jit and vmap.
    """
    seen = jnp.where(field_of_view(params.config)[0], bev > 0, False)
    enough = seen.sum((-2, -1), dtype=jnp.int32) >= FEWEST_CELLS
    return enough & jnp.isfinite(bev).all((-2, -1))


def segment(params: Params, bev: Num[Array, "*b h w"]) -> Float[Array, "*b h w k"]:
    """Compute the semantic logits of each image with the segmentation head of the training.

    Raises:
      ValueError: If the model has no segmentation head.
    """
    if not params.config.segments:
        raise ValueError("expected a model with a segmentation head, found one without (for place recognition only)")
    return forward(params, bev).logits.reshape(*bev.shape, -1)


def forward(
    params: Params,
    bev: Num[Array, "*b h w"],
    labels: Int[Array, "... h w"] | None = None,
    *,
    key: Array | None = None,
    segment: int = 1,
) -> Outputs:
    """Compute descriptors, logits and named maps in one pass, for training and pictures.

    The leading axes of the images are merged into one.

    Arguments:
      params: Model.
      bev: Images, as in `describe`.
      labels: Class maps, as in `describe`.
      key: Random key. With a key this is the training pass, in which stochastic depth drops residual branches.
      segment: Interval between images with logits: n for every n-th image, 0 for no logits. A model without a
        segmentation head gives no logits.

    Raises:
      ValueError: In the same cases as `describe`, or if there are no images.
    """
    config = params.config
    grid = config.grid
    _check_array(bev)
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


def _check_array(bev: Any) -> None:
    """Raise TypeError for a list. JAX would treat each of its numbers as an argument."""
    if not hasattr(bev, "shape"):
        raise TypeError(f"expected images as an array of numpy or JAX, found a {type(bev).__name__}; use np.asarray")


def _check_labels(labels: Array | None, shape: tuple[Any, ...], config: ModelConfig) -> None:
    """Raise ValueError if the head reads labels and they are missing, or if it reads no labels and they are given."""
    found = "none" if labels is None else f"shape {labels.shape}"
    if config.head.reads_labels and (labels is None or labels.shape != shape):
        raise ValueError(
            f"the place head of this model reads {config.head.input}: expected class maps of shape {shape}, "
            f"one for each image, found {found}"
        )
    if labels is not None and not config.head.reads_labels:
        raise ValueError(f"the place head of this model reads {config.head.input}: expected no labels, found {found}")


def init(key: Array, *, preset: str = "sglpr", config: ModelConfig | None = None) -> Params:
    """Initialise the weights of a named preset, or of `config` if it is given.

    Only the weights that the configuration needs are created. No program is compiled.
    """
    config = model_preset(preset) if config is None else config
    shape = (1, config.grid.height, config.grid.width)
    image = jax.ShapeDtypeStruct((*shape, config.channels), jnp.float32)
    labels = jax.ShapeDtypeStruct(shape, jnp.int32) if config.head.reads_labels else None
    created = jax.eval_shape(SGLPR(config).init, key, image, labels)
    return Params(draw_all(key, created["initial"], created["params"]), config)
