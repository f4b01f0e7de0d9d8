"""What a model is, as plain values: the static part of its parameters."""

import dataclasses
import math
from typing import Literal

from sglpr_jax.bev import Grid, ImageKind
from sglpr_jax.data.density_image import check_density_grid
from sglpr_jax.labels import Categories, label_map


@dataclasses.dataclass(frozen=True)
class HeadConfig:
    """The place head: CBAM, three convolutions, NetVLAD (section 4.1.2).

    The paper names no kernels, strides or channels; candidates A to D are compared in docs/decisions.md.
    """

    input: Literal["features", "counts", "labels", "counts+labels"] = "features"
    """What it reads (table 6): the backbone's features (HS), the image of point counts (RB), its true semantic map
    (RS), or both (RB+RS). Only `features` needs a backbone; the others have none, and no segmentation head."""
    tap: Literal["pixels", "tokens"] = "pixels"
    """`pixels`: the x4-expanded map before the last linear layer. `tokens`: the patch map it is expanded from."""
    channels: tuple[int, ...] = (128, 256, 512)
    kernels: tuple[int, ...] = (3, 3, 3)
    strides: tuple[int, ...] = (2, 2, 2)
    cbam: bool = True
    cbam_reduction: int = 16
    pooling: Literal["netvlad", "mean", "spectrum"] = "netvlad"
    """`mean`: the mean over the map and a linear layer stand in for NetVLAD (table 4). `spectrum`: the amplitudes of
    the map's Fourier transform along the sectors of a polar image (models/spectrum.py)."""
    clusters: int = 64
    spectrum_channels: int = 256
    frequencies: int = 32
    descriptor_size: int = 256

    def __post_init__(self):
        if not len(self.channels) == len(self.kernels) == len(self.strides):
            raise ValueError(
                "the head needs as many kernels and strides as channels, found "
                f"channels {self.channels}, kernels {self.kernels}, strides {self.strides}"
            )

    @property
    def reads_labels(self) -> bool:
        """Whether a descriptor needs the semantic map too."""
        return "labels" in self.input


@dataclasses.dataclass(frozen=True)
class RingConfig:
    """A backbone of convolutions that go around the polar image (models/ring_net.py), a block for each width."""

    average: int = 2
    """Edge of the squares of polar pixels whose means the first block sees: without, the resampling skips cells."""
    widths: tuple[int, ...] = (16, 32, 64, 96, 128, 160, 160)
    strides: tuple[int, ...] = (2, 2, 1, 2, 1, 1, 1)
    """Of each block, along the radius."""
    means: tuple[int, ...] = (1, 1, 2, 1, 2, 1, 1)
    """How many neighbouring sectors become one after each block."""

    def __post_init__(self):
        if not len(self.widths) == len(self.strides) == len(self.means):
            raise ValueError(
                "the ring net needs as many strides and means as widths, found "
                f"widths {self.widths}, strides {self.strides}, means {self.means}"
            )


@dataclasses.dataclass(frozen=True)
class ModelConfig:
    """A Swin-Unet, or a ring net, with a place head and a segmentation head, over images of `grid`."""

    grid: Grid = Grid()
    image: ImageKind = "points"
    """What raw scans are made into: the point counts of equation 1, or density images as the ready-made ones of KITTI
    are (`density_bev`), for a model trained on those. Ready-made images are taken as they are."""
    counts: Literal["raw", "log1p", "clipped"] = "log1p"
    """How point counts become network input: as they are, log(1 + n), or min(n, 10) / 10."""
    field: Literal["square", "circle"] = "square"
    """`circle` blanks the cells outside the largest circle, so that a rotation moves nothing in or out of view."""
    blind_m: float = 0.0
    """Blanks the cells nearer than this to the sensor: they hold the vehicle's own body."""
    range_channel: bool = False
    """A second input channel with every cell's distance: how many points the bare ground returns depends on it, and
    windowed attention knows only relative positions."""
    polar: tuple[int, int] | None = None
    """(rings, sectors): let the backbone see the image in polar form, where a rotation of the scan is a shift."""
    rings: RingConfig | None = None
    """The backbone is a ring net in place of the Swin-Unet; the fields from `patch` to `drop_path` then say nothing."""
    patch: int = 4
    stem: tuple[int, ...] = ()
    """Widths of convolutions before the patch embedding, the second and later ones at half the resolution of the one
    before; the segmentation head sees each of them again. (): none, as in the paper."""
    embed_dim: int = 96
    depths: tuple[int, ...] = (2, 2, 2, 2)
    heads: tuple[int, ...] = (3, 6, 12, 24)
    window: int = 7
    mlp_ratio: int = 4
    drop_path: float = 0.2
    categories: Categories = 20
    """Into how many categories labels are sorted (figure 9, docs/labels.md); 0: no segmentation head."""
    detail: int = 0
    """Width of a layer that shows the segmentation head the image beside the features. 0: none, as in the paper."""
    compute: Literal["float32", "bfloat16"] = "float32"
    """In what matrices are multiplied and images convolved. Weights, norms, softmax, NetVLAD's sums, the descriptor and
    the losses are float32 all the same."""
    head: HeadConfig = HeadConfig()

    def __post_init__(self):
        if self.head.reads_labels and not self.categories:
            raise ValueError(f"a head that reads {self.head.input} needs categories of labels, found 0")
        if len(self.depths) != len(self.heads):
            raise ValueError(f"one number of heads per stage is needed, found depths {self.depths}, heads {self.heads}")
        if self.image == "density":
            check_density_grid(self.grid)
        if self.polar and self.field != "circle":
            raise ValueError(f"a polar image covers a circle: expected field 'circle', found {self.field!r}")
        if self.stem and self.patch % 2 ** (len(self.stem) - 1):
            raise ValueError(
                f"a stem of {len(self.stem)} widths makes pixels of {2 ** (len(self.stem) - 1)} cells, of which a "
                f"patch must be made, found patch {self.patch}"
            )
        if self.rings and not self.polar:
            raise ValueError("a ring net sees a polar image: expected model.polar (rings, sectors), found none")
        for size, step in zip(self.image_size, self._steps, strict=True):
            if size % step:
                raise ValueError(
                    f"the backbone's image must be a multiple of {self._steps} cells, found {self.image_size}"
                )

    @property
    def _steps(self) -> tuple[int, int]:
        """Of how many rows and columns of the backbone's image its coarsest features are made."""
        if self.rings:
            return self.rings.average * math.prod(self.rings.strides), self.rings.average * math.prod(self.rings.means)
        return (self.patch * 2 ** (len(self.depths) - 1),) * 2

    @property
    def classes(self) -> int:
        """Classes of a semantic map, the unlabelled one included."""
        return len(label_map(self.categories).names) if self.categories else 0

    @property
    def categories_read(self) -> int:
        """The categories of the semantic maps that a descriptor needs; 0 where it needs none."""
        return self.categories if self.head.reads_labels else 0

    @property
    def segments(self) -> bool:
        """Whether there is a segmentation head."""
        return self.head.input == "features" and self.categories > 0

    @property
    def channels(self) -> int:
        """Channels of the image that the network sees."""
        return 2 if self.range_channel else 1

    @property
    def image_size(self) -> tuple[int, int]:
        """Rows and columns of the image that the backbone sees."""
        return self.polar or (self.grid.height, self.grid.width)

    @property
    def token_pixels(self) -> int:
        """Edge of a token's patch in pixels of the map that the backbone reads: the image, or the stem's last."""
        return self.patch // 2 ** max(len(self.stem) - 1, 0)
