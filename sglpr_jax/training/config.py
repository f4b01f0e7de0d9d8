"""The settings of a training run, as plain values: no JAX is needed to read them. Presets in configs/ fill it in."""

import dataclasses
from typing import Literal

from sglpr_jax.data.sampling.config import TupleConfig, ValidationConfig
from sglpr_jax.fields import Count, CountOrNone, Degrees, NotNegative, Positive, Share, check_fields
from sglpr_jax.models.config import ModelConfig


@dataclasses.dataclass(frozen=True)
class LossConfig:
    """Equations 5 and 8. The paper gives no margin and no distance: docs/decisions/paper.md has ours."""

    margin: NotNegative = 0.3
    squared: bool = False
    """Square the descriptor distances of equation 5."""
    closest_positive: bool = True
    reduction: Literal["max", "sum"] = "max"
    """`max` is the lazy triplet loss; `sum` counts every negative inside the margin."""
    temperature: NotNegative = 0.0
    """Above 0: the smooth form of the lazy loss, which hard negatives cannot collapse."""
    one_threshold: Share = 0.0
    """Share of the triplet loss in which every anchor has the negatives of all anchors (`losses.one_threshold`). It is
    for one threshold on distances that all places share. 0 in the paper."""
    ce_weight: NotNegative = 0.4
    dice_weight: NotNegative = 0.6
    segment_every: Count = 1
    """Take the segmentation losses on every n-th image of a step only; all are segmented in the paper."""
    class_balance: NotNegative = 0.0
    """Exponent a of the cross-entropy's class weights n^-a, n being the class's pixels in the image; 0 in the paper."""
    ignore_unlabelled: bool = False
    """Leave cells of class 0 (empty or unlabelled) out of the segmentation losses, as the scores do."""
    segmentation_alone: bool = False
    """Teach nothing but the layers that make the semantic map: descriptors stay as they are, bit for bit. Not in the
    paper, where both are learnt at once."""

    def __post_init__(self):
        check_fields(self)
        if self.segmentation_alone and not self.segments:
            raise ValueError("loss.segmentation_alone leaves no loss where ce_weight and dice_weight are 0")

    @property
    def segments(self) -> bool:
        """Whether any term reads the segmentation head. One whose weight is 0 is not computed (table 7).

        A new term of the class logits joins with its weight, for the table in `training/loss.py` needs JAX.
        """
        return self.ce_weight != 0 or self.dice_weight != 0


@dataclasses.dataclass(frozen=True)
class OptimizerConfig:
    """Adam with an exponential decay of the learning rate."""

    learning_rate: NotNegative = 1e-5
    warmup_steps: CountOrNone = 0
    decay_rate: Positive = 0.99
    decay_steps: Count = 1000
    """Steps in which the learning rate falls by `decay_rate`."""
    staircase: bool = False
    clip_norm: Positive | None = None
    weight_decay: NotNegative = 0.0

    def __post_init__(self):
        check_fields(self)


@dataclasses.dataclass(frozen=True)
class OcclusionConfig:
    """Sectors without points, hidden from images in training; none in the paper."""

    share: Share = 0.0
    """Of the images of a step."""
    widest_deg: Degrees = 180.0
    """How wide the widest sector may be; all widths up to it are as likely."""

    def __post_init__(self):
        check_fields(self)


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """One training run."""

    model: ModelConfig = ModelConfig()
    sampling: TupleConfig = TupleConfig()
    loss: LossConfig = LossConfig()
    optimizer: OptimizerConfig = OptimizerConfig()
    validation: ValidationConfig = ValidationConfig()
    select: Literal["last", "best"] = "last"
    """Which weights a finished run hands out: its last ones, or those of the best score on what is held out."""
    steps: Count = 40_000
    tuples: Count = 1
    """Tuples a step."""
    share_negatives: bool = False
    """Let every other tuple's places that are far enough away be negatives too."""
    also_tuples: CountOrNone = 0
    """How many of a step's tuples come from the second dataset."""
    also_triplets: bool = False
    """Let these count in the triplet loss. Without it they are places at random, for the segmentation alone."""
    chunk: CountOrNone = 0
    """Images that go through the network at a time, on all devices together (0: all). It changes memory and speed; of
    the results only which branches stochastic depth drops."""
    rotate: bool = True
    """Rotate every place about z by its own random angle at every step."""
    quarter_turns: Share = 0.0
    """Of the places, this share is rotated by a multiple of 90 degrees, which blurs no cell; the rest by any angle."""
    occlusion: OcclusionConfig = OcclusionConfig()
    max_points: Count = 131072
    """Clouds are padded to this many points; larger ones are thinned evenly."""
    seed: CountOrNone = 0
    log_every: Count = 10
    score_every: Count = 1000
    """Steps between scores and checkpoints."""

    def __post_init__(self):
        check_fields(self)
        if not 0 <= self.also_tuples < self.tuples:
            raise ValueError(
                f"also_tuples must be fewer than the {self.tuples} tuples of a step, found {self.also_tuples}"
            )
        if self.loss.segmentation_alone and not self.model.segments:
            raise ValueError("loss.segmentation_alone expected a model with a segmentation head, found one without")
        if self.loss.segmentation_alone and self.optimizer.weight_decay:
            raise ValueError(
                "loss.segmentation_alone keeps all other weights as they are: expected optimizer.weight_decay 0, "
                f"found {self.optimizer.weight_decay}"
            )
        if self.select == "best" and not self.validation.share:
            raise ValueError("select best needs places held out to choose by: expected a validation.share, found 0")
        if self.chunk and self.images % self.chunk:
            raise ValueError(f"chunk must divide the {self.images} images of a step, found {self.chunk}")
        if self.images_at_once % self.loss.segment_every:
            raise ValueError(
                f"loss.segment_every must divide the {self.images_at_once} images of a chunk, "
                f"found {self.loss.segment_every}"
            )

    @property
    def images(self) -> int:
        """Images a step."""
        return self.tuples * (1 + self.sampling.positives + self.sampling.negatives)

    @property
    def images_at_once(self) -> int:
        """Images of a chunk."""
        return self.chunk or self.images


def without_untrained_head(config: TrainConfig) -> TrainConfig:
    """The same training without labels, and so without a segmentation head, where neither a loss nor the place head
    reads them: weights that no loss reaches would be kept and handed out untrained."""
    if config.model.head.reads_labels or (config.model.segments and config.loss.segments):
        return config
    return dataclasses.replace(config, model=dataclasses.replace(config.model, categories=0))
