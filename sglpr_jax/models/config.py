"""Configuration of a model: its image, backbone and heads; presets, and the configuration in a file.

This module imports no JAX, so a command line can list its fields quickly.
"""

import contextlib
import dataclasses
import typing
from pathlib import Path
from typing import Any, Literal

from sglpr_jax.categories import RAW_IDS, Categories
from sglpr_jax.fields import (
    NotNegative,
    Size,
    SizeOrZero,
    Sizes,
    check_fields,
    field_types,
    is_config,
    read_value,
    require,
)
from sglpr_jax.files import naming
from sglpr_jax.grid import Grid, ImageKind, check_density_grid
from sglpr_jax.models.backbone_config import BackboneConfig, SglprConfig, SwinConfig, check_lengths

WHITENING_POWER = 0.4
"""Default power of whitening: each principal component is divided by its spread raised to this power."""


@dataclasses.dataclass(frozen=True)
class HeadConfig:
    """Place head: CBAM, three convolutions and NetVLAD (section 4.1.2). The paper gives no kernel sizes or channels."""

    input: Literal["features", "counts", "labels", "counts+labels"] = "features"
    """Input of the head (table 6): the features of the backbone (HS), the image of point counts (RB), its ground-truth
    semantic map (RS), or image and map (RB+RS). Only `features` has a backbone and a segmentation head."""
    tap: Literal["pixels", "tokens"] = "pixels"
    """Feature map that the head reads. `pixels`: the output of the decoder. `tokens`: the input of the decoder."""
    channels: Sizes = (128, 256, 512)
    """Channels of each convolution."""
    kernels: Sizes = (3, 3, 3)
    strides: Sizes = (2, 2, 2)
    means: Sizes = ()
    """Number of neighbouring sectors of a polar map that are averaged into one after each convolution. The strides then
    apply to the radius only. (): no averaging, as in the paper."""
    cbam: bool = True
    """Whether CBAM first weights the map by channel and by position."""
    cbam_reduction: Size = 16
    """Channels per hidden unit of CBAM's channel gate."""
    pooling: Literal["netvlad", "mean"] = "netvlad"
    """Pooling of the map into one vector. `mean`: average pooling and a linear layer replace NetVLAD (table 4)."""
    clusters: Size = 64
    """Number of NetVLAD clusters."""
    descriptor_size: Size = 256
    whiten: bool = False
    """Whether a last linear layer equalises the spread of the descriptors in all directions (`bin/export --whiten`)."""

    def __post_init__(self):
        check_fields(self)
        check_lengths("the head", channels=self.channels, kernels=self.kernels, strides=self.strides)
        if self.means and (len(self.means) != len(self.channels) or set(self.kernels) != {3}):
            raise ValueError(
                "means: expected one number for each convolution, and 3 x 3 kernels, found "
                f"means {self.means}, kernels {self.kernels}"
            )

    @property
    def reads_features(self) -> bool:
        """Whether the head reads the features of a backbone."""
        return self.input == "features"

    @property
    def reads_labels(self) -> bool:
        """Whether a descriptor requires the ground-truth semantic map."""
        return "labels" in self.input

    @property
    def pictures(self) -> dict[str, str]:
        """Intermediate maps to draw as heat maps: from the title of each picture to the name of its map."""
        if self.cbam:
            return {"CBAM": "cbam"}
        return {"place head, first": "head_convolution0"} if self.channels else {}


@dataclasses.dataclass(frozen=True)
class ModelConfig:
    """SG-LPR (figure 2): a backbone with a place head and a segmentation head, for images of `grid`."""

    grid: Grid = Grid()
    image: ImageKind = "points"
    """Image that a scan is converted to: point counts (equation 1), or a density image like KITTI's ready-made ones."""
    counts: Literal["raw", "log1p", "clipped"] = "log1p"
    """Conversion of point counts to network input: unchanged, log(1 + n), or min(n, 10) / 10."""
    field: Literal["square", "circle"] = "square"
    """`circle` sets the cells outside the largest circle to 0, so that a rotation moves nothing in or out of view."""
    blind_m: NotNegative = 0.0
    """Radius around the sensor in which cells are set to 0, in metres. These cells show the vehicle itself."""
    range_channel: bool = False
    """Whether a second input channel holds the distance of each cell from the sensor, which attention in windows cannot
    know. The number of points on bare ground depends on it."""
    polar: tuple[Size, Size] | None = None
    """(radii, sectors) of a polar image for the backbone, in which a rotation is a shift. None: Cartesian image."""
    backbone: BackboneConfig = SwinConfig()
    head: HeadConfig = HeadConfig()
    """Configuration of the place head."""
    categories: Categories = 20
    """Number of categories of the labels (figure 9, docs/reference/labels.md). 0: no segmentation head."""
    detail: SizeOrZero = 0
    """Width of a layer that adds the image to the features of the segmentation head. 0: no layer, as in the paper."""
    descriptors_of: str = ""
    """SHA-256 of the weights whose descriptors this model learned (`loss.teacher`). Maps and files of both have this
    hash, so each model can search those of the other. Empty: the model has descriptors of its own."""
    compute: Literal["float32", "bfloat16"] = "float32"
    """Data type of matrix products and convolutions. Weights, norms, softmax, descriptors and losses are float32."""

    def __post_init__(self):
        check_fields(self)
        reach_m = min(self.grid.height, self.grid.width) * self.grid.resolution_m / 2
        if self.blind_m >= reach_m:
            raise ValueError(
                f"blind_m: expected less than the {reach_m:g} m that the image reaches, found {self.blind_m}"
            )
        if self.head.reads_labels and not self.categories:
            raise ValueError(f"expected categories of labels for a head that reads {self.head.input}, found 0")
        if self.image == "density":
            check_density_grid(self.grid)
        if self.polar and self.field != "circle":
            raise ValueError(f"a polar image covers a circle: expected field 'circle', found {self.field!r}")
        if self.backbone.needs_polar and not self.polar:
            raise ValueError(
                f"the backbone {self.backbone.kind!r} requires a polar image: expected model.polar (radii, sectors), "
                "found none"
            )
        if self.head.means and not self.polar:
            raise ValueError("head.means requires a polar image: expected model.polar (radii, sectors), found none")
        (rows, columns), (row_multiple, column_multiple) = self.image_size, self.backbone.multiple
        if rows % row_multiple or columns % column_multiple:
            raise ValueError(
                f"the backbone requires an image size that is a multiple of {self.backbone.multiple} cells, "
                f"found {self.image_size}"
            )

    @property
    def segments(self) -> bool:
        """Whether the model has a segmentation head."""
        return self.head.reads_features and self.categories > 0

    @property
    def classes(self) -> int:
        """Number of classes of a semantic map, including the unlabelled class."""
        return len(RAW_IDS[self.categories]) if self.categories else 0

    @property
    def categories_read(self) -> int:
        """Number of categories of the semantic maps that a descriptor requires, or 0 if it requires no map."""
        return self.categories if self.head.reads_labels else 0

    @property
    def channels(self) -> int:
        """Number of channels of the network's input."""
        return 2 if self.range_channel else 1

    @property
    def image_size(self) -> tuple[int, int]:
        """Rows and columns of the backbone's input."""
        return self.polar or (self.grid.height, self.grid.width)

    @property
    def pictures(self) -> dict[str, str]:
        """Intermediate maps to draw as heat maps: from the title of each picture to the name of its map."""
        if self.head.reads_features:
            return {**self.backbone.pictures, **self.head.pictures}
        return self.head.pictures or {"input of the place head": "raw_input"}


REMOVED = (("backbone.stem", []), ("backbone.stem.kind", "rings"), ("backbone.stem.kind", "circular"))
"""Fields of earlier versions, with their values, that the configuration no longer has. They are ignored in files."""
ADDED_LATER = {
    "head.means": (),
    "head.whiten": False,
    "backbone.stem.fine": (),
    "descriptors_of": "",
}
"""Fields that files of earlier versions lack, and the values that these files imply."""


def config_from_dict(values: Any, *, source: Path | str) -> ModelConfig:
    """Rebuild a configuration from the output of `dataclasses.asdict`.

    Every field is required, except the fields in `ADDED_LATER`.

    Raises ValueError if a field is missing, unknown or invalid. The message names `source`, the field, and the expected
    and the found value.
    """
    with naming(source):
        return _read_field(ModelConfig, values, field="")


def _read_field(annotation: Any, value: Any, field: str) -> Any:
    """Return the value of a field, converted to its type. A dictionary becomes a configuration class.

    If the annotation is a union of classes, the entry `kind` of the dictionary selects one. `field` is the path of the
    field, for example `backbone.stem`, or "" for the whole configuration. Raises ValueError if the value is invalid.
    """
    classes = [member for member in (annotation, *typing.get_args(annotation)) if is_config(member)]
    if not classes:
        return read_value(value, annotation, field)
    require(value, isinstance(value, dict), f"the fields of a {' or '.join(c.__name__ for c in classes)}", field)
    prefix = f"{field}." if field else ""
    values = {name: entry for name, entry in value.items() if (prefix + name, entry) not in REMOVED}
    config_class = classes[0]
    if len(classes) > 1:
        kind = values.get("kind")
        by_kind: dict[Any, Any] = {member.kind: member for member in classes}
        require(kind, isinstance(kind, str) and kind in by_kind, f"a kind, {' or '.join(by_kind)}", field)
        config_class = by_kind[kind]
    types = field_types(config_class)
    values = {name: ADDED_LATER[prefix + name] for name in types if prefix + name in ADDED_LATER} | values
    unknown = min(map(str, set(values) - set(types)), default=None)
    missing = min(set(types) - set(values), default=None)
    expected = f"the fields of a {config_class.__name__} ({', '.join(types)})"
    require(unknown, unknown is None, expected, field)
    if missing is not None:
        raise ValueError(f"{f'{field}: ' if field else ''}expected {expected}, found no {missing!r}")
    converted = {name: _read_field(types[name], entry, prefix + name) for name, entry in values.items()}
    with naming(field) if field else contextlib.nullcontext():  # the class raises if its fields are inconsistent
        return config_class(**converted)


_SGLPR = ModelConfig(
    grid=Grid(resolution_m=0.4, height=128, width=128),
    image="density",
    field="circle",
    blind_m=2.6,
    range_channel=True,
    polar=(64, 256),
    backbone=SglprConfig(),
    head=HeadConfig(tap="tokens", channels=(96, 128, 160), strides=(2, 1, 1), means=(1, 2, 1)),
    detail=32,
)

MODELS: dict[str, ModelConfig] = {
    # The default: the paper's parts in a form that follows rotations. Circular convolutions, then windows, CBAM and
    # NetVLAD, on polar images of the window of the ready-made KITTI images (+-25.6 m).
    "sglpr": _SGLPR,
    # The same without attention, and with fewer sectors in the head: a third of the computation.
    "sglpr-small": dataclasses.replace(
        _SGLPR,
        backbone=SglprConfig(depths=(), heads=()),
        head=dataclasses.replace(_SGLPR.head, means=(2, 2, 1), whiten=True),
        categories=0,
    ),
    # The paper's model with a literal head: three 3 x 3 convolutions of stride 2 on 224 x 224 x 96.
    "paper": ModelConfig(),
    # All stages of the paper's Swin-Unet and its window, with cells of 0.4 m as in the ready-made KITTI images.
    "paper-112": ModelConfig(
        grid=Grid(resolution_m=0.4, height=112, width=112), image="density", backbone=SwinConfig(patch=2)
    ),
    # For tests: every part of the model, with little computation.
    "tiny": ModelConfig(
        grid=Grid(resolution_m=1.6, height=32, width=32),
        backbone=SwinConfig(embed_dim=8, depths=(1, 1), heads=(1, 2), window=4, drop_path=0.1),
        head=HeadConfig(channels=(8, 8, 16), kernels=(4, 3, 3), strides=(4, 2, 1), clusters=4),
    ),
}


def model_preset(name: str) -> ModelConfig:
    """Return the model configuration with this name. Raises ValueError for an unknown name."""
    if name not in MODELS:
        raise ValueError(f"expected a model preset ({', '.join(MODELS)}), found {name!r}")
    return MODELS[name]
