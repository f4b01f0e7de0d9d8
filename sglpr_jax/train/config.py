"""Everything a training run is told, as plain values. Presets in configs/ fill it in."""

import dataclasses
from typing import Literal

from sglpr_jax.data.held_out import ValidationConfig
from sglpr_jax.data.tuples import TupleConfig
from sglpr_jax.models.config import ModelConfig


@dataclasses.dataclass(frozen=True)
class LossConfig:
    """Equations 5 and 8. The paper gives no margin and no distance; docs/decisions.md says where these come from."""

    margin: float = 0.3
    squared: bool = False
    """Square the descriptor distances of equation 5."""
    closest_positive: bool = True
    reduction: Literal["max", "sum"] = "max"
    """`max` is the lazy triplet loss; `sum` counts every negative inside the margin."""
    temperature: float = 0.0
    """Above 0: the smooth form of the lazy loss, which hard negatives cannot collapse."""
    one_threshold: float = 0.0
    """Share of the triplet loss in which the negatives of all anchors are an anchor's (`losses.one_threshold`): one
    threshold on distances for all places needs it. 0 in the paper."""
    ce_weight: float = 0.4
    dice_weight: float = 0.6
    segment_every: int = 1
    """Take the segmentation losses on every n-th image of a step only; all are segmented in the paper."""
    class_balance: float = 0.0
    """Exponent a of the cross-entropy's class weights n^-a, n being the class's pixels in the image; 0 in the paper."""
    ignore_unlabelled: bool = False
    """Leave cells of class 0 (empty or unlabelled) out of the segmentation losses, as the scores do."""

    @property
    def segments(self) -> bool:
        """Whether any term reads the segmentation head. One whose weight is 0 is not computed (table 7)."""
        return self.ce_weight != 0 or self.dice_weight != 0


@dataclasses.dataclass(frozen=True)
class OptimizerConfig:
    """Adam with an exponential decay of the learning rate."""

    learning_rate: float = 1e-5
    warmup_steps: int = 0
    decay_rate: float = 0.99
    decay_steps: int = 1000
    """Steps in which the learning rate falls by `decay_rate`."""
    staircase: bool = False
    clip_norm: float | None = None
    weight_decay: float = 0.0


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """One training run.

    Where nothing reads labels, neither a loss nor the place head, `model.categories` becomes 0: weights that no loss
    reaches would be kept and handed out untrained.
    """

    model: ModelConfig = ModelConfig()
    sampling: TupleConfig = TupleConfig()
    loss: LossConfig = LossConfig()
    optimizer: OptimizerConfig = OptimizerConfig()
    validation: ValidationConfig = ValidationConfig()
    select: Literal["last", "best"] = "last"
    """Which weights a finished run hands out: its last ones, or those of the best score on what is held out."""
    steps: int = 40_000
    tuples: int = 1
    """Tuples a step."""
    share_negatives: bool = False
    """Let every other tuple's places that are far enough away be negatives too."""
    also_tuples: int = 0
    """How many of a step's tuples come from the datasets of --also."""
    also_triplets: bool = False
    """Let these count in the triplet loss. Without it they are places at random, for the segmentation alone."""
    chunk: int = 0
    """Images that go through the network at a time, on all devices together (0: all). It changes memory and speed; of
    the results only which branches stochastic depth drops."""
    rotate: bool = True
    """Turn every place about z by its own random angle at every step."""
    max_points: int = 131072
    """Clouds are padded to this many points; larger ones are thinned evenly."""
    seed: int = 0
    log_every: int = 10
    score_every: int = 1000
    """Steps between scores and checkpoints."""

    def __post_init__(self):
        learns_semantics = self.model.segments and self.loss.segments
        if not (learns_semantics or self.model.head.reads_labels):
            object.__setattr__(self, "model", dataclasses.replace(self.model, categories=0))
        if not 0 <= self.also_tuples < self.tuples:
            raise ValueError(
                f"also_tuples must be fewer than the {self.tuples} tuples of a step, found {self.also_tuples}"
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
