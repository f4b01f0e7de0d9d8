"""The network, and the calls that users make: `describe`, `segment`, `forward`, `is_describable` and `init`."""

import functools
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Num

from sglpr_jax.labels import UNLABELLED
from sglpr_jax.models.backbone_config import BackboneConfig, SwinConfig
from sglpr_jax.models.circular import CircularDecoder
from sglpr_jax.models.config import ModelConfig, model_preset
from sglpr_jax.models.initial import draw_all
from sglpr_jax.models.input_image import FEWEST_CELLS, backbone_view, field_of_view, prepare
from sglpr_jax.models.place_head import PlaceHead, input_without_backbone
from sglpr_jax.models.segmentation_head import segmentation_head
from sglpr_jax.models.swin import PatchExpand
from sglpr_jax.models.swin_unet import CircularSwin, SwinUnet
from sglpr_jax.models.weights import Params, by_name


def _encode(
    config: BackboneConfig, image: Float[Array, "b p q c"], *, circular: bool, train: bool
) -> tuple[list[Array], dict[str, Array]]:
    """Run the backbone, in layers of the calling Flax module.

    Returns:
      The maps for `_decode`, with the features as the last one, and all intermediate maps by name.
    """
    if isinstance(config, SwinConfig):
        tokens, maps_by_name = SwinUnet(config, config.patch, circular, name="backbone")(image, train=train)
        return [tokens], maps_by_name
    return CircularSwin(config, name="backbone")(image, train=train)


def _decode(config: BackboneConfig, maps: list[Array]) -> Float[Array, "b _ _ _"]:
    """Compute features of pixels from the maps of `_encode`, in layers of the calling Flax module."""
    if isinstance(config, SwinConfig):
        return PatchExpand(config.patch, maps[-1].shape[-1], name="expand")(maps[-1])
    return CircularDecoder(config.stem.widths, name="decoder")(maps)


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
        """Compute descriptors, and logits of every `segment`-th image (0: no logits)."""
        config = self.config
        circular = config.polar is not None
        place_head = PlaceHead(config.head, circular=circular, name="place_head")
        if not config.head.reads_features:  # such a model has no backbone (table 6)
            raw_input = input_without_backbone(image, labels, config)
            descriptor, head_maps = place_head(raw_input)
            return Outputs(descriptor, None, {"raw_input": raw_input, **head_maps})
        maps, maps_by_name = _encode(config.backbone, backbone_view(image, config), circular=circular, train=train)
        all_pixels = _decode(config.backbone, maps) if config.head.tap == "pixels" else None
        descriptor, head_maps = place_head(maps[-1] if all_pixels is None else all_pixels)
        maps_by_name = {**maps_by_name, **head_maps}
        if segment == 0 or not config.segments:
            return Outputs(descriptor, None, maps_by_name)
        # If the place head does not need the pixels, only those of the images with logits are computed.
        pixels = _decode(config.backbone, [x[::segment] for x in maps]) if all_pixels is None else all_pixels[::segment]
        logits = segmentation_head(pixels, image[::segment], config)
        return Outputs(descriptor, logits, {**maps_by_name, "pixels": pixels})


@jax.jit
def describe(
    params: Params, bev: Num[Array, "*b h w"], labels: Int[Array, "... h w"] | None = None
) -> Float[Array, "*b d"]:
    """Compute the descriptor of each bird's-eye-view image, also under jit, vmap and grad.

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
    _check_is_array(bev)
    if 0 in bev.shape[:-2]:  # no images, which `forward` rejects
        return jnp.zeros((*bev.shape[:-2], params.config.head.descriptor_size))
    return forward(params, bev, labels, segment=0).descriptor.reshape(*bev.shape[:-2], -1)


@jax.jit
def is_describable(params: Params, bev: Num[Array, "*b h w"]) -> Bool[Array, "*b"]:
    """Whether each image shows a place: its counts are finite, and at least 2 cells in view have points."""
    occupied = jnp.where(field_of_view(params.config)[0], bev > 0, False)
    return (occupied.sum((-2, -1), dtype=jnp.int32) >= FEWEST_CELLS) & jnp.isfinite(bev).all((-2, -1))


def segment(params: Params, bev: Num[Array, "*b h w"]) -> Float[Array, "*b h w k"]:
    """Compute the semantic logits of each image. Raises ValueError if the model has no segmentation head."""
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
    """Compute descriptors, logits and named maps in one pass. The leading axes of the images are merged into one.

    Arguments:
      params: Model.
      bev: Images, as in `describe`.
      labels: Class maps, as in `describe`.
      key: Random key. With a key this is the training pass, in which stochastic depth drops residual branches.
      segment: Interval between images with logits: n for every n-th image, 0 for no logits.

    Raises:
      ValueError: In the same cases as `describe`, or if there are no images.
    """
    config = params.config
    grid = config.grid
    _check_is_array(bev)
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


def _check_is_array(bev: Any) -> None:
    """Raise TypeError if the images are no array. JAX would treat each number of a list as an argument."""
    if not hasattr(bev, "shape"):
        raise TypeError(f"expected images as an array of numpy or JAX, found a {type(bev).__name__}; use np.asarray")


def _check_labels(labels: Array | None, shape: tuple[Any, ...], config: ModelConfig) -> None:
    """Raise ValueError if the head reads labels and none have the `shape` of the images, or if it reads no labels."""
    expected_shape = shape if config.head.reads_labels else None
    found_shape = None if labels is None else labels.shape
    if found_shape != expected_shape:
        expected = "no labels" if expected_shape is None else f"class maps of shape {shape}, one for each image"
        found = "none" if found_shape is None else f"shape {found_shape}"
        raise ValueError(f"the place head of this model reads {config.head.input}: expected {expected}, found {found}")


def init(key: Array, *, preset: str = "sglpr", config: ModelConfig | None = None) -> Params:
    """Initialise the weights of a named preset, or of `config` if it is given, without compiling a program."""
    config = model_preset(preset) if config is None else config
    shape = (1, config.grid.height, config.grid.width)
    image = jax.ShapeDtypeStruct((*shape, config.channels), jnp.float32)
    labels = jax.ShapeDtypeStruct(shape, jnp.int32) if config.head.reads_labels else None
    traced = jax.eval_shape(SGLPR(config).init, key, image, labels)
    distributions, shapes = traced["initial"], traced["params"]
    return Params(draw_all(key, distributions, shapes), config)


@functools.cache
def weight_shapes(config: ModelConfig) -> dict[str, jax.ShapeDtypeStruct]:
    """Return the shape and type of every weight of a configuration, without computing the weights."""
    return by_name(jax.eval_shape(lambda: init(jax.random.key(0), config=config)).weights)
