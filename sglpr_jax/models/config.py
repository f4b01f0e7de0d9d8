"""What a model is, as plain values: the static part of its parameters.

Here stands what all models share; each backbone keeps its own configuration beside its layers. Neither imports JAX, so
that a command line can name all fields at once.
"""

import dataclasses
from typing import Literal

from sglpr_jax.categories import RAW_IDS, Categories
from sglpr_jax.data.density_grid import check_density_grid
from sglpr_jax.fields import NotNegative, Size, SizeOrNone, Sizes, check_fields
from sglpr_jax.grid import Grid, ImageKind
from sglpr_jax.models.backbones.rings_config import RingConfig
from sglpr_jax.models.backbones.sglpr_config import SglprConfig
from sglpr_jax.models.backbones.swin_config import SwinConfig

BackboneConfig = SwinConfig | RingConfig | SglprConfig
"""The backbones there are; `models/backbones/interface.py` says what each one has."""

WHITENING_POWER = 0.4
"""By which power of its spread the last layer divides a principal component, where none is named."""


@dataclasses.dataclass(frozen=True)
class HeadConfig:
    """The place head: CBAM, three convolutions, NetVLAD (section 4.1.2).

    The paper names no kernels, strides or channels: the presets `paper` and `paper-head-b` are two readings of it
    (docs/decisions/paper.md).
    """

    input: Literal["features", "counts", "labels", "counts+labels"] = "features"
    """What it reads (table 6): the backbone's features (HS), the image of point counts (RB), its true semantic map
    (RS), or both (RB+RS). Only `features` needs a backbone; the others have none, and no segmentation head."""
    tap: Literal["pixels", "tokens"] = "pixels"
    """`pixels`: the decoder's map, before the last linear layer. `tokens`: the features that it is decoded from."""
    channels: Sizes = (128, 256, 512)
    """Of each convolution."""
    kernels: Sizes = (3, 3, 3)
    strides: Sizes = (2, 2, 2)
    means: Sizes = ()
    """How many neighbouring sectors of a polar map become one after each convolution. With these the strides are along
    the radius alone, and convolutions and CBAM go around, so that a rotation of the scan is a shift. (): as in the
    paper."""
    cbam: bool = True
    """Weight the map by channel and by place first."""
    cbam_reduction: Size = 16
    """Channels for each hidden unit of CBAM's channel gate."""
    pooling: Literal["netvlad", "mean", "spectrum"] = "netvlad"
    """`mean`: the mean over the map and a linear layer stand in for NetVLAD (table 4). `spectrum`: the amplitudes of
    the map's Fourier transform along the sectors of a polar image (models/heads/spectrum.py)."""
    clusters: Size = 64
    """Of NetVLAD."""
    descriptor_size: Size = 256
    whiten: bool = False
    """Whether a last linear layer spreads the descriptors evenly over their directions (models/whitening.py)."""

    def __post_init__(self):
        check_fields(self)
        if not len(self.channels) == len(self.kernels) == len(self.strides):
            raise ValueError(
                "expected as many kernels and strides as channels of the head, found "
                f"channels {self.channels}, kernels {self.kernels}, strides {self.strides}"
            )
        if self.means and (len(self.means) != len(self.channels) or set(self.kernels) != {3}):
            raise ValueError(
                "expected a number of sectors for each convolution and 3 x 3 kernels of a head that goes around, found "
                f"means {self.means}, kernels {self.kernels}"
            )

    @property
    def reads_features(self) -> bool:
        """Whether there is a backbone in front of it."""
        return self.input == "features"

    @property
    def reads_counts(self) -> bool:
        """Whether it reads the image itself."""
        return self.input in ("counts", "counts+labels")

    @property
    def reads_labels(self) -> bool:
        """Whether a descriptor needs the true semantic map."""
        return self.input in ("labels", "counts+labels")

    @property
    def pictures(self) -> dict[str, str]:
        """Which of its maps are drawn: what a picture is called, and the map's name."""
        if self.cbam:
            return {"CBAM": "cbam"}
        return {"place head, first": "head_convolution0"} if self.channels else {}


@dataclasses.dataclass(frozen=True)
class ModelConfig:
    """SG-LPR (figure 2): a backbone with a place head and a segmentation head, over images of `grid`."""

    grid: Grid = Grid()
    image: ImageKind = "points"
    """What raw scans are made into: the point counts of equation 1, or density images as the ready-made ones of KITTI
    are (`density_bev`), for a model trained on those. Ready-made images are taken as they are."""
    counts: Literal["raw", "log1p", "clipped"] = "log1p"
    """How point counts become network input: as they are, log(1 + n), or min(n, 10) / 10."""
    field: Literal["square", "circle"] = "square"
    """`circle` blanks the cells outside the largest circle, so that a rotation moves nothing in or out of view."""
    blind_m: NotNegative = 0.0
    """Blanks the cells nearer than this to the sensor: they hold the vehicle's own body."""
    range_channel: bool = False
    """A second input channel with every cell's distance: how many points the bare ground returns depends on it, and
    windowed attention knows only relative positions."""
    polar: tuple[Size, Size] | None = None
    """(radii, sectors): let the backbone see the image in polar form, where a rotation of the scan is a shift."""
    backbone: BackboneConfig = SwinConfig()
    head: HeadConfig = HeadConfig()
    """The place head."""
    categories: Categories = 20
    """Into how many categories labels are sorted (figure 9, docs/reference/labels.md); 0: no segmentation head."""
    detail: SizeOrNone = 0
    """Width of a layer that shows the segmentation head the image beside the features. 0: none, as in the paper."""
    compute: Literal["float32", "bfloat16"] = "float32"
    """In what matrices are multiplied and images convolved. Weights, norms, softmax, NetVLAD's sums, the descriptor and
    the losses are float32 all the same."""

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
                f"the backbone {self.backbone.kind!r} sees a polar image: expected model.polar (radii, sectors), "
                "found none"
            )
        if self.head.means and not self.polar:
            raise ValueError("a head that goes around needs a polar image: expected model.polar, found none")
        rows_and_columns = zip(self.image_size, self.backbone.multiple, strict=True)
        if any(size % step for size, step in rows_and_columns):
            raise ValueError(
                f"expected an image of a multiple of {self.backbone.multiple} cells, as the backbone needs, "
                f"found {self.image_size}"
            )

    @property
    def segments(self) -> bool:
        """Whether there is a segmentation head."""
        return self.head.reads_features and self.categories > 0

    @property
    def classes(self) -> int:
        """Classes of a semantic map, the unlabelled one included."""
        return len(RAW_IDS[self.categories]) if self.categories else 0

    @property
    def categories_read(self) -> int:
        """The categories of the semantic maps that a descriptor needs; 0 where it needs none."""
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
        """Of which maps heat maps are drawn: what a picture is called, and the map's name."""
        if self.head.reads_features:
            return {**self.backbone.pictures, **self.head.pictures}
        return self.head.pictures or {"input of the place head": "raw_input"}
