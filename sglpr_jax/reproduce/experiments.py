"""The paper's experiments as data: the variants of the model that each table and figure compares."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from sglpr_jax.training.config import TrainConfig, without_untrained_head

TOP1, PAIRS = "top1-f1max", "pairs-f1max"
FULL = "full"
NO_SEGMENTATION = "no-segmentation"


VARIANTS: dict[str, Mapping[str, Any]] = {
    FULL: {},
    "no-rotation": {"rotate": False},
    "convolutions": {"model.head.cbam": False, "model.head.pooling": "mean"},
    "no-cbam": {"model.head.cbam": False},
    NO_SEGMENTATION: {"model.categories": 0},
    "counts": {"model.head.input": "counts"},
    "labels": {"model.head.input": "labels"},
    "counts-and-labels": {"model.head.input": "counts+labels"},
    "no-dice": {"loss.dice_weight": 0.0},
    "no-cross-entropy": {"loss.ce_weight": 0.0},
    "raw-counts": {"model.counts": "raw"},
    "clipped-counts": {"model.counts": "clipped"},
    **{f"categories-{n}": {"model.categories": n} for n in (6, 15, 25, 34)},
}
"""Changes of each variant to the preset: fields of `TrainConfig` by their dotted names, as flags of bin/train."""


@dataclass(frozen=True)
class Experiment:
    """A table or figure of the paper: its title and the variants that it compares."""

    title: str
    variants: Mapping[str, str] = field(default_factory=lambda: {FULL: "SG-LPR"})
    """Label of each variant in this experiment, by the variant's name."""
    rotated: bool = False
    """Whether every scan of the test recordings is rotated by its own random angle."""
    beside_handcrafted: bool = False
    """Whether handcrafted methods and other weights are compared with the variants."""
    across_sessions: bool = False
    """Whether the test recordings are sessions of another dataset. Each variant then needs only one model: the one
    trained without the first recording."""
    protocols: tuple[str, ...] = (TOP1,)
    """Protocols of a table. One table is written for each, with the published rows of this protocol."""
    needs_labels: bool = False
    """Whether the experiment draws labels or compares variants that learn from them."""


EXPERIMENTS: dict[str, Experiment] = {
    "table1": Experiment("F1max beside other methods", beside_handcrafted=True, protocols=(TOP1, PAIRS)),
    "table2": Experiment(
        "F1max, every scan rotated",
        {FULL: "SG-LPR", "no-rotation": "SG-LPR, not rotated in training"},
        rotated=True,
        beside_handcrafted=True,
        protocols=(TOP1, PAIRS),
    ),
    "table3": Experiment(
        "Recall@1 across NCLT sessions, trained on other recordings",
        beside_handcrafted=True,
        across_sessions=True,
    ),
    "table4": Experiment(
        "CBAM and NetVLAD",
        {"convolutions": "convolutions", "no-cbam": "convolutions, NetVLAD", FULL: "convolutions, CBAM, NetVLAD"},
    ),
    "table5": Experiment("The segmentation branch", {NO_SEGMENTATION: "without", FULL: "with"}, needs_labels=True),
    "table6": Experiment(
        "Input of the place head",
        {
            "counts": "RB: counts",
            "labels": "RS: labels",
            "counts-and-labels": "RB+RS: counts and labels",
            FULL: "HS: features",
        },
        needs_labels=True,
    ),
    "table7": Experiment(
        "Terms of the loss",
        {
            NO_SEGMENTATION: "triplet",
            "no-dice": "triplet, cross-entropy",
            "no-cross-entropy": "triplet, Dice",
            FULL: "triplet, cross-entropy, Dice",
        },
        needs_labels=True,
    ),
    "figure5": Experiment("Precision and recall", beside_handcrafted=True),
    "figure6": Experiment("Top-1 retrieval along the trajectory"),
    "figure7": Experiment("Counts, true and predicted semantic maps", needs_labels=True),
    "figure8": Experiment(
        "Feature heat maps with and without the segmentation branch",
        {FULL: "with", NO_SEGMENTATION: "without"},
        across_sessions=True,
        needs_labels=True,
    ),
    "figure9": Experiment(
        "Number of semantic categories",
        {
            NO_SEGMENTATION: "0",
            "categories-6": "6",
            "categories-15": "15",
            FULL: "20",
            "categories-25": "25",
            "categories-34": "34",
        },
        needs_labels=True,
    ),
    "normalisation": Experiment(
        "Point counts as input (not in the paper)",
        {"raw-counts": "n", "clipped-counts": "min(n, 10) / 10", FULL: "log(1 + n)"},
    ),
}


def variant_config(preset: TrainConfig, variant: str) -> TrainConfig:
    """Return the preset with the changes of a variant, which is a name in `VARIANTS`."""
    config = preset
    for name, value in VARIANTS[variant].items():
        config = _with_field(config, name, value)
    return without_untrained_head(config)


def _with_field(config: Any, path: str, value: Any) -> Any:
    """Return a configuration with another value of the field at a dotted path, such as `model.head.cbam`."""
    name, _, path_within = path.partition(".")
    if path_within:
        value = _with_field(getattr(config, name), path_within, value)
    return dataclasses.replace(config, **{name: value})
