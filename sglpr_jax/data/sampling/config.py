"""Which places a training draws and which it holds out, as plain values."""

import dataclasses
from typing import Annotated, Literal

from sglpr_jax.fields import Bounds, Count, CountOrNone, NotNegative, Share, check_fields
from sglpr_jax.same_place import NEGATIVE_M, POSITIVE_M


@dataclasses.dataclass(frozen=True)
class TupleConfig:
    """How tuples are drawn. Distances are horizontal: ground-truth heights drift by metres within a recording."""

    positives: Count = 1
    negatives: CountOrNone = 10
    positive_m: NotNegative = POSITIVE_M
    negative_m: NotNegative = NEGATIVE_M
    revisit_fraction: Share = 0.5
    """The share of tuples whose positives come from another visit; the others' come from neighbouring frames."""
    revisit_gap: CountOrNone = 50
    """Frames at most this far apart belong to one visit."""
    cluster: Count = 1
    """Tuples in a row whose anchors lie near each other. Where tuples share their places as negatives, neighbouring
    places of one street are harder to tell apart than any two of a whole recording."""
    cluster_m: NotNegative = 100.0
    """How near: the distance to the first anchor of the row."""
    mining: Literal["none", "hardest"] = "none"
    """`none`: negatives at random, as in the paper. `hardest`: those that look most like the anchor (BEVPlace++); the
    anchors of a cluster are then alike rather than near each other."""
    hardest: CountOrNone = 10
    """Negatives are drawn from this many places: those that look most like the anchor, beyond the negative distance."""
    refresh_steps: CountOrNone = 1000
    """Steps after which the descriptors that mining compares are computed anew."""
    mined_places: CountOrNone = 0
    """Places that are described then, other ones each time, and anchors of the tuples drawn; 0: all."""

    def __post_init__(self):
        check_fields(self)
        if self.mining == "none":
            return
        if self.negatives == 0 and self.cluster == 1:
            raise ValueError(
                "sampling.mining chooses negatives or the other anchors of a cluster: expected sampling.negatives or "
                "sampling.cluster above 0 and 1, found 0 and 1"
            )
        if min(self.hardest, self.refresh_steps) < 1:
            raise ValueError(
                "expected sampling.hardest and sampling.refresh_steps of 1 or more, found "
                f"{self.hardest} and {self.refresh_steps}"
            )


@dataclasses.dataclass(frozen=True)
class ValidationConfig:
    """What is held out of every training recording."""

    share: Annotated[float, Bounds(0, 0.5)] = 0.0
    """The length of a stretch of frames in a row, as a share of the recording; 0: nothing, as in the paper."""

    def __post_init__(self):
        check_fields(self)
