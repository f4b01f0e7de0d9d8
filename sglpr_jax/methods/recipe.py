"""Settings of a training: the choice of its tuples (anchor, positives, negatives), and the recipe of a method."""

import dataclasses
from typing import Literal

from sglpr_jax.fields import Count, CountOrZero, NotNegative, Share, check_fields
from sglpr_jax.same_place import NEGATIVE_M, POSITIVE_M, SAME_PASS_FRAMES


@dataclasses.dataclass(frozen=True)
class TupleConfig:
    """Choice of anchors, positives and negatives. Distances are horizontal, because heights drift by metres."""

    positives: Count = 1
    """Number of positives of an anchor."""
    negatives: CountOrZero = 10
    """Number of negatives of an anchor."""
    positive_m: NotNegative = POSITIVE_M
    """Maximum distance of a positive from its anchor, in metres."""
    negative_m: NotNegative = NEGATIVE_M
    """Minimum distance of a negative from its anchor, in metres."""
    revisit_fraction: Share = 0.5
    """Fraction of tuples with positives from another visit. In the other tuples, positives are neighbouring frames."""
    revisit_gap: CountOrZero = SAME_PASS_FRAMES
    """Minimum length of a visit, in frames. It lasts until the sensor is away for as many frames."""
    cluster: Count = 1
    """Number of consecutive tuples with anchors near each other, so that shared negatives are from the same street."""
    cluster_m: NotNegative = 100.0
    """Maximum distance of the anchors of a cluster from its first anchor, in metres."""
    mining: Literal["none", "hardest"] = "none"
    """`none`: random negatives, as in the paper. `hardest`: negatives whose descriptors are most similar to the
    anchor's (BEVPlace++). The anchors of a cluster then have similar descriptors instead of being near each other."""
    hardest: CountOrZero = 10
    """Number of most similar places beyond `negative_m`, from which negatives are drawn."""
    refresh_steps: CountOrZero = 1000
    """Number of steps after which mining recomputes the descriptors."""
    mined_places: CountOrZero = 0
    """Number of random places that mining then describes and draws anchors from. 0: all places."""

    def __post_init__(self):
        check_fields(self)
        if self.positive_m > self.negative_m:
            raise ValueError(
                f"expected sampling.negative_m of at least sampling.positive_m, {self.positive_m}, "
                f"found {self.negative_m}"
            )
        if self.mining == "none":
            return
        if self.negatives == 0 and self.cluster == 1:
            raise ValueError(
                "sampling.mining selects negatives and the anchors of a cluster: expected sampling.negatives above 0 "
                "or sampling.cluster above 1, found 0 and 1"
            )
        if min(self.hardest, self.refresh_steps) < 1:
            raise ValueError(
                "expected sampling.hardest and sampling.refresh_steps of 1 or more, found "
                f"{self.hardest} and {self.refresh_steps}"
            )


@dataclasses.dataclass(frozen=True)
class Recipe:
    """Settings of the training of a learned method, besides its loss."""

    sampling: TupleConfig
    tuples: int
    """Number of tuples in a step."""
    learning_rates: tuple[float, float, float]
    """Learning rates that the search tries, smallest first. The second is the published one, if it is known."""
    weight_decay: float = 0.0
