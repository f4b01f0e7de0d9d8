"""Settings of a training run as plain values, readable without JAX. The presets in configs/ set them."""

import dataclasses
from typing import Annotated, Literal

from sglpr_jax.fields import Bounds, Count, CountOrZero, Degrees, NotNegative, Positive, Share, check_fields
from sglpr_jax.methods.recipe import TupleConfig
from sglpr_jax.models.config import ModelConfig


@dataclasses.dataclass(frozen=True)
class LossConfig:
    """Weights and variants of the loss (equations 5 and 8).

    The paper gives no margin and no distance. docs/decisions.md explains the values used here.
    """

    margin: NotNegative = 0.3
    """Margin of the triplet loss."""
    squared: bool = False
    """Use squared descriptor distances in equation 5."""
    temperature: NotNegative = 0.0
    """If above 0, use the smooth form of the lazy loss, which hard negatives cannot collapse."""
    one_threshold: Share = 0.0
    """Fraction of the triplet loss in which every anchor has the negatives of all anchors. All places then share one
    distance threshold (`losses.one_threshold`). 0 in the paper."""
    ce_weight: NotNegative = 0.4
    """Weight of the cross-entropy."""
    dice_weight: NotNegative = 0.6
    """Weight of the Dice loss."""
    segment_every: Count = 1
    """Compute the segmentation losses on every n-th image of a step only. 1 in the paper."""
    class_balance: NotNegative = 0.0
    """Exponent a of the class weights n^-a in the cross-entropy, where n is the number of pixels of the class in the
    image. 0 in the paper."""
    ignore_unlabelled: bool = False
    """Exclude cells of class 0 (empty or unlabelled) from the segmentation losses, as the scores do."""
    teacher: str | None = None
    """Weights whose descriptors the network learns instead of the triplet loss: a name or a folder, as in --weights.
    Maps and descriptor files of the teacher can then be searched by the network, and the reverse."""
    segmentation_alone: bool = False
    """Train only the layers of the semantic map. Descriptors stay bit-identical. The paper trains both together."""

    def __post_init__(self):
        check_fields(self)
        if self.segmentation_alone and not self.segments:
            raise ValueError(
                "loss.segmentation_alone leaves no loss: expected ce_weight or dice_weight above 0, found 0"
            )
        if self.segmentation_alone and self.teacher:
            raise ValueError(
                f"loss.segmentation_alone trains no descriptors: expected no loss.teacher, found {self.teacher}"
            )

    @property
    def segments(self) -> bool:
        """Whether any term of the loss uses the segmentation head. Terms with weight 0 are not computed (table 7).

        A new `SegmentationTerm` must be added here, too: this module cannot read the table, which needs JAX.
        """
        return self.ce_weight != 0 or self.dice_weight != 0


@dataclasses.dataclass(frozen=True)
class OptimizerConfig:
    """Adam or Muon with exponential decay of the learning rate."""

    algorithm: Literal["adam", "muon"] = "adam"
    """`adam`, as in the paper. `muon` gives the update of a matrix equal singular values, so that one learning rate
    suits layers of any width (Muon, Jordan 2024). Adam updates the vectors with a tenth of the learning rate."""
    learning_rate: NotNegative = 1e-5
    """Learning rate after the warm-up."""
    warmup_steps: CountOrZero = 0
    """Steps in which the learning rate rises linearly from 0."""
    decay_rate: Positive = 0.99
    """Factor of the learning rate after each `decay_steps` steps."""
    decay_steps: Count = 1000
    """Steps in which the learning rate falls by the factor `decay_rate`."""
    staircase: bool = False
    """Let the learning rate fall in jumps instead of continuously."""
    clip_norm: Positive | None = None
    """Maximum global norm of the gradient. None: no clipping."""

    def __post_init__(self):
        check_fields(self)


@dataclasses.dataclass(frozen=True)
class OcclusionConfig:
    """Random sectors hidden from images in training. The paper has no occlusion."""

    share: Share = 0.0
    """Fraction of the images of a step that are occluded."""
    widest_deg: Degrees = 180.0
    """Maximum width of the hidden sector, in degrees. Widths are drawn uniformly from 0 to this value."""

    def __post_init__(self):
        check_fields(self)


@dataclasses.dataclass(frozen=True)
class ValidationConfig:
    """Held-out part of every world of the training (`Recording.world`)."""

    share: Annotated[float, Bounds(0, 0.5)] = 0.0
    """Length of the held-out stretch of consecutive frames, as a fraction of the first recording of a world. 0: none,
    as in the paper."""

    def __post_init__(self):
        check_fields(self)


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """Settings of one training run."""

    model: ModelConfig = ModelConfig()
    sampling: TupleConfig = TupleConfig()
    loss: LossConfig = LossConfig()
    optimizer: OptimizerConfig = OptimizerConfig()
    validation: ValidationConfig = ValidationConfig()
    steps: Count = 40_000
    """Number of training steps."""
    tuples: Count = 1
    """Tuples per step."""
    share_negatives: bool = False
    """Use the places of all tuples of a step as negatives, if they are far enough away."""
    also_tuples: CountOrZero = 0
    """Tuples per step from the second dataset, included in `tuples`."""
    also_triplets: bool = False
    """Include the tuples of the second dataset in the triplet loss. Otherwise they are random places for the
    segmentation losses alone."""
    chunk: CountOrZero = 0
    """Images that pass through the network at a time, on all devices together; 0: all. Fewer images need less memory.
    Results differ only by the random branches that stochastic depth drops."""
    rotate: bool = True
    """Rotate every place about z by a random angle at every step."""
    quarter_turns: Share = 0.0
    """Fraction of the places that are rotated by a multiple of 90 degrees, which blurs no cells. The others are rotated
    by any angle."""
    occlusion: OcclusionConfig = OcclusionConfig()
    max_points: Count = 131072
    """Maximum number of points of a scan. Smaller scans are padded to this size, and larger scans are thinned
    evenly."""
    seed: CountOrZero = 0
    """Seed of the weights and of all random choices."""
    log_every: Count = 10
    """Steps between lines of the log."""
    score_every: Count = 1000
    """Steps between scores and checkpoints."""

    def __post_init__(self):
        check_fields(self)
        if not 0 <= self.also_tuples < self.tuples:
            raise ValueError(
                f"also_tuples must be fewer than the {self.tuples} tuples of a step, found {self.also_tuples}"
            )
        if self.loss.segmentation_alone and not self.model.segments:
            raise ValueError("loss.segmentation_alone: expected a model with a segmentation head, found one without")
        triplet_tuples = self.tuples if self.also_triplets else self.tuples - self.also_tuples
        has_negatives = self.sampling.negatives > 0 or (self.share_negatives and triplet_tuples > 1)
        if self.needs_negatives and not has_negatives:
            raise ValueError(
                "the triplet loss has no negatives: expected sampling.negatives above 0, or share_negatives and "
                f"several tuples, found {self.sampling.negatives}, {self.share_negatives} and {triplet_tuples}"
            )
        if self.chunk and self.images % self.chunk:
            raise ValueError(f"chunk must divide the {self.images} images of a step, found {self.chunk}")
        if self.images_at_once % self.loss.segment_every:
            raise ValueError(
                f"loss.segment_every must divide the {self.images_at_once} images of a chunk, "
                f"found {self.loss.segment_every}"
            )

    @property
    def needs_negatives(self) -> bool:
        """Whether the loss compares places with places elsewhere."""
        return not (self.loss.teacher or self.loss.segmentation_alone)

    @property
    def images(self) -> int:
        """Images per step."""
        return self.tuples * (1 + self.sampling.positives + self.sampling.negatives)

    @property
    def images_at_once(self) -> int:
        """Images per chunk."""
        return self.chunk or self.images


def without_untrained_head(config: TrainConfig) -> TrainConfig:
    """Remove labels and segmentation head from a configuration if neither a loss nor the place head uses them.

    Otherwise the run would save weights that were never trained.
    """
    if config.model.head.reads_labels or (config.model.segments and config.loss.segments):
        return config
    return dataclasses.replace(config, model=dataclasses.replace(config.model, categories=0))
