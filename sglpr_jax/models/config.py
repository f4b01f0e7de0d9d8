"""Configuration of a model as plain values: the static part of its parameters.

This file holds what all models share. Each backbone has its own configuration beside its layers. None of these files
imports JAX, so a command line can list all fields quickly.
"""

import dataclasses
from typing import Literal

from sglpr_jax.categories import RAW_IDS, Categories
from sglpr_jax.data.density_grid import check_density_grid
from sglpr_jax.fields import NotNegative, Size, SizeOrNone, Sizes, check_fields
from sglpr_jax.grid import Grid, ImageKind
from sglpr_jax.models.backbones.config import BackboneConfig
from sglpr_jax.models.backbones.swin_config import SwinConfig

WHITENING_POWER = 0.4
"""Default power of whitening: each principal component is divided by its spread raised to this power."""


@dataclasses.dataclass(frozen=True)
class HeadConfig:
    """Place head: CBAM, three convolutions and NetVLAD (section 4.1.2).

    The paper gives no kernel sizes, strides or channels. The preset `paper` is one interpretation
    (docs/decisions/paper.md).
    """

    input: Literal["features", "counts", "labels", "counts+labels"] = "features"
    """Input of the head (table 6): the features of the backbone (HS), the image of point counts (RB), its ground-truth
    semantic map (RS), or both (RB+RS). Only with `features` does the model have a backbone and a segmentation head."""
    tap: Literal["pixels", "tokens"] = "pixels"
    """Feature map that the head reads. `pixels`: the output of the decoder, before the last linear layer. `tokens`: the
    features from which the decoder starts."""
    channels: Sizes = (128, 256, 512)
    """Channels of each convolution."""
    kernels: Sizes = (3, 3, 3)
    strides: Sizes = (2, 2, 2)
    means: Sizes = ()
    """Number of neighbouring sectors of a polar map that are averaged into one after each convolution. With averaging,
    the strides apply to the radius only, and the convolutions and CBAM use circular padding. A rotation of the scan is
    then a shift. (): no averaging, as in the paper."""
    cbam: bool = True
    """Whether CBAM first weights the map by channel and by position."""
    cbam_reduction: Size = 16
    """Channels per hidden unit of CBAM's channel gate."""
    pooling: Literal["netvlad", "mean", "spectrum"] = "netvlad"
    """Pooling of the map into one vector. `mean`: average pooling and a linear layer replace NetVLAD (table 4).
    `spectrum`: amplitudes of the map's Fourier transform along the sectors of a polar image
    (models/heads/spectrum.py)."""
    clusters: Size = 64
    """Number of NetVLAD clusters."""
    descriptor_size: Size = 256
    whiten: bool = False
    """Whether a last linear layer equalises the spread of the descriptors over their directions
    (models/whitening.py)."""

    def __post_init__(self):
        check_fields(self)
        if not len(self.channels) == len(self.kernels) == len(self.strides):
            raise ValueError(
                "expected equal numbers of channels, kernels and strides of the head, found "
                f"channels {self.channels}, kernels {self.kernels}, strides {self.strides}"
            )
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
    def reads_counts(self) -> bool:
        """Whether the head reads the image itself."""
        return self.input in ("counts", "counts+labels")

    @property
    def reads_labels(self) -> bool:
        """Whether a descriptor requires the ground-truth semantic map."""
        return self.input in ("labels", "counts+labels")

    @property
    def pictures(self) -> dict[str, str]:
        """Maps of the head to draw as heat maps: from the title of each picture to the name of its map."""
        if self.cbam:
            return {"CBAM": "cbam"}
        return {"place head, first": "head_convolution0"} if self.channels else {}


@dataclasses.dataclass(frozen=True)
class ModelConfig:
    """SG-LPR (figure 2): a backbone with a place head and a segmentation head, for images of `grid`."""

    grid: Grid = Grid()
    image: ImageKind = "points"
    """Kind of image that raw scans are converted to: point counts (equation 1), or density images like the ready-made
    ones of KITTI (`density_bev`). Ready-made images are not converted."""
    counts: Literal["raw", "log1p", "clipped"] = "log1p"
    """Conversion of point counts to network input: unchanged, log(1 + n), or min(n, 10) / 10."""
    field: Literal["square", "circle"] = "square"
    """`circle` blanks the cells outside the largest circle, so that a rotation moves nothing in or out of view."""
    blind_m: NotNegative = 0.0
    """Radius around the sensor in which cells are blanked, in metres. These cells show the vehicle itself."""
    range_channel: bool = False
    """Whether a second input channel holds the distance of each cell. The number of points on bare ground depends on
    the distance, and windowed attention knows only relative positions."""
    polar: tuple[Size, Size] | None = None
    """(radii, sectors) of a polar image for the backbone, in which a rotation of the scan is a shift. None: Cartesian
    image."""
    backbone: BackboneConfig = SwinConfig()
    head: HeadConfig = HeadConfig()
    """Configuration of the place head."""
    categories: Categories = 20
    """Number of categories of the labels (figure 9, docs/reference/labels.md). 0: no segmentation head."""
    detail: SizeOrNone = 0
    """Width of a layer that adds the image to the features of the segmentation head. 0: no layer, as in the paper."""
    compute: Literal["float32", "bfloat16"] = "float32"
    """Data type of matrix products and convolutions. Weights, norms, softmax, the sums of NetVLAD, the descriptor and
    the losses are always float32."""

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
        rows_and_columns = zip(self.image_size, self.backbone.multiple, strict=True)
        if any(size % step for size, step in rows_and_columns):
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
        """Channels of the image that the network sees."""
        return 2 if self.range_channel else 1

    @property
    def image_size(self) -> tuple[int, int]:
        """Rows and columns of the image that the backbone sees."""
        return self.polar or (self.grid.height, self.grid.width)

    @property
    def pictures(self) -> dict[str, str]:
        """Maps to draw as heat maps: from the title of each picture to the name of its map."""
        if self.head.reads_features:
            return {**self.backbone.pictures, **self.head.pictures}
        return self.head.pictures or {"input of the place head": "raw_input"}
