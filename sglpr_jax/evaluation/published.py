"""Numbers of the SG-LPR paper: tables 1 to 7, row by row as printed.

The rows of a table do not share one protocol. The paper names the source of each row. The protocol of each source is
our reading (docs/concepts/protocols.md):

- RINET, "RINet's paper": `pairs-f1max`, F1max over pairs with 100 negatives per positive.
- ITS_PAPER, "its own paper": `top1-f1max`, top-1 F1max with 3 m, 20 m and 30 s.
- NO_SOURCE: not known.
- OWN_RUN, "run by SG-LPR's authors": not stated; most likely `top1-f1max`.
- BEVPLACE_2, "BEVPlace++'s paper": `bevplace-nclt-recall`, Recall@1 across sessions of NCLT with 5 m.

In tables 1 and 2 the printed mean of SC_LPR is 0.850, but the mean of its row is 0.853. All other means agree within
rounding.

Our numbers are comparable with these only under the same protocol, on the same poses and on the real dataset.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

Kind = Literal["handcrafted", "learned"]
HANDCRAFTED, LEARNED = "handcrafted", "learned"
RINET, ITS_PAPER, OWN_RUN = "RINet's paper", "its own paper", "run by SG-LPR's authors"
BEVPLACE_2, NO_SOURCE = "BEVPlace++'s paper", "no source named"

KITTI = ("00", "02", "05", "06", "07", "08")
NCLT = ("2012-02-04", "2012-03-17", "2012-06-15", "2012-09-28", "2012-11-16", "2013-02-23")
NCLT_DATABASE = "2012-01-15"
"""Database session of table 3."""


@dataclass(frozen=True)
class Row:
    """Scores of one method or variant, in the order of the columns of its table."""

    method: str
    scores: tuple[float, ...]
    mean: float
    """Mean as printed. It may differ from the mean of the rounded scores."""
    kind: Kind
    source: str
    """Source of the numbers according to the paper. It determines the protocol."""

    @property
    def f1max_protocol(self) -> str:
        """Name of the protocol of an F1max, in tables 1 and 2."""
        return "pairs-f1max" if self.source == RINET else "top1-f1max"


@dataclass(frozen=True)
class Table:
    """One table of the paper. The columns are sequences."""

    number: int
    title: str
    dataset: str
    columns: tuple[str, ...]
    rows: tuple[Row, ...]

    def column(self, sequence: str, *, kind: Kind | None = None) -> Mapping[str, float]:
        """Return the scores on one sequence by method, optionally of one kind. Empty for an unknown sequence."""
        if sequence not in self.columns:
            return {}
        i = self.columns.index(sequence)
        return {row.method: row.scores[i] for row in self.rows if kind in (None, row.kind)}


TABLE_1 = Table(
    1,
    "F1max on KITTI",
    "real KITTI",
    KITTI,
    (
        Row("M2DP", (0.708, 0.717, 0.602, 0.787, 0.560, 0.073), 0.575, HANDCRAFTED, RINET),
        Row("Scan Context", (0.750, 0.782, 0.895, 0.968, 0.662, 0.607), 0.777, HANDCRAFTED, RINET),
        Row("LiDAR Iris", (0.668, 0.762, 0.768, 0.913, 0.629, 0.478), 0.703, HANDCRAFTED, RINET),
        Row("PointNetVLAD", (0.779, 0.727, 0.541, 0.852, 0.631, 0.037), 0.595, LEARNED, RINET),
        Row("OverlapTransformer", (0.952, 0.853, 0.909, 0.987, 0.330, 0.256), 0.715, LEARNED, OWN_RUN),
        Row("DiSCO", (0.964, 0.892, 0.964, 0.990, 0.897, 0.903), 0.935, LEARNED, ITS_PAPER),
        Row("LoGG3D-Net", (0.953, 0.888, 0.976, 0.977, 1.000, 0.843), 0.939, LEARNED, ITS_PAPER),
        Row("BEVPlace", (0.979, 0.900, 0.974, 0.991, 0.906, 0.894), 0.941, LEARNED, OWN_RUN),
        Row("SSC", (0.951, 0.891, 0.951, 0.985, 0.875, 0.940), 0.932, HANDCRAFTED, RINET),
        Row("SGPR", (0.820, 0.751, 0.751, 0.655, 0.868, 0.750), 0.766, LEARNED, RINET),
        Row("Locus", (0.957, 0.745, 0.968, 0.948, 0.921, 0.900), 0.907, LEARNED, ITS_PAPER),
        Row("RINet", (0.978, 0.947, 0.917, 0.978, 0.967, 0.869), 0.943, LEARNED, RINET),
        Row("SC_LPR", (0.900, 0.870, 0.920, 0.910, 0.870, 0.650), 0.850, LEARNED, NO_SOURCE),
        Row("SG-LPR", (0.980, 0.918, 0.976, 1.000, 1.000, 0.898), 0.962, LEARNED, OWN_RUN),
    ),
)

TABLE_2 = Table(
    2,
    "F1max on KITTI, every scan rotated at random about z",
    "real KITTI",
    KITTI,
    (
        Row("M2DP", (0.276, 0.282, 0.341, 0.316, 0.204, 0.201), 0.270, HANDCRAFTED, RINET),
        Row("Scan Context", (0.719, 0.734, 0.844, 0.898, 0.606, 0.546), 0.725, HANDCRAFTED, RINET),
        Row("LiDAR Iris", (0.667, 0.764, 0.772, 0.912, 0.633, 0.470), 0.703, HANDCRAFTED, RINET),
        Row("PointNetVLAD", (0.083, 0.090, 0.490, 0.094, 0.064, 0.086), 0.151, LEARNED, RINET),
        Row("DiSCO", (0.960, 0.891, 0.952, 0.985, 0.894, 0.892), 0.929, LEARNED, RINET),
        Row("BEVPlace", (0.979, 0.900, 0.974, 0.991, 0.906, 0.894), 0.941, LEARNED, OWN_RUN),
        Row("SSC", (0.955, 0.889, 0.952, 0.986, 0.876, 0.943), 0.934, HANDCRAFTED, RINET),
        Row("SGPR", (0.772, 0.716, 0.723, 0.640, 0.748, 0.678), 0.713, LEARNED, RINET),
        Row("Locus", (0.944, 0.726, 0.960, 0.927, 0.911, 0.877), 0.891, LEARNED, RINET),
        Row("RINet", (0.992, 0.942, 0.954, 1.000, 0.990, 0.962), 0.973, LEARNED, RINET),
        Row("SC_LPR", (0.900, 0.870, 0.920, 0.910, 0.870, 0.650), 0.850, LEARNED, RINET),
        Row("SG-LPR", (0.969, 0.913, 0.976, 0.993, 1.000, 0.880), 0.955, LEARNED, OWN_RUN),
    ),
)

TABLE_3 = Table(
    3,
    "Recall@1 on NCLT, trained on KITTI",
    "real NCLT",
    NCLT,
    (
        Row("M2DP", (0.632, 0.580, 0.424, 0.406, 0.493, 0.279), 0.469, HANDCRAFTED, BEVPLACE_2),
        Row("BoW3D", (0.149, 0.107, 0.065, 0.050, 0.052, 0.075), 0.083, HANDCRAFTED, BEVPLACE_2),
        Row("CVTNet", (0.892, 0.880, 0.812, 0.749, 0.771, 0.803), 0.818, LEARNED, BEVPLACE_2),
        Row("LoGG3D-Net", (0.699, 0.196, 0.110, 0.087, 0.109, 0.256), 0.243, LEARNED, BEVPLACE_2),
        Row("LCDNet", (0.605, 0.542, 0.442, 0.349, 0.317, 0.109), 0.394, LEARNED, BEVPLACE_2),
        Row("BEVPlace", (0.935, 0.927, 0.874, 0.878, 0.889, 0.862), 0.894, LEARNED, BEVPLACE_2),
        Row("BEVPlace++", (0.953, 0.942, 0.902, 0.889, 0.913, 0.878), 0.913, LEARNED, BEVPLACE_2),
        Row("SG-LPR", (0.947, 0.936, 0.931, 0.916, 0.914, 0.913), 0.926, LEARNED, OWN_RUN),
    ),
)

TABLE_4 = Table(
    4,
    "Ablation of CBAM and NetVLAD, F1max on KITTI",
    "real KITTI",
    KITTI,
    (
        Row("convolutions", (0.926, 0.836, 0.878, 0.991, 0.224, 0.716), 0.762, LEARNED, OWN_RUN),
        Row("convolutions, NetVLAD", (0.961, 0.906, 0.936, 0.983, 0.885, 0.819), 0.915, LEARNED, OWN_RUN),
        Row("convolutions, CBAM, NetVLAD", (0.980, 0.918, 0.976, 1.000, 1.000, 0.898), 0.962, LEARNED, OWN_RUN),
    ),
)

TABLE_5 = Table(
    5,
    "Ablation of the segmentation branch, F1max on KITTI",
    "real KITTI",
    KITTI,
    (
        Row("without semantic segmentation", (0.932, 0.842, 0.903, 0.975, 0.604, 0.785), 0.840, LEARNED, OWN_RUN),
        Row("with semantic segmentation", (0.980, 0.918, 0.976, 1.000, 1.000, 0.898), 0.962, LEARNED, OWN_RUN),
    ),
)

TABLE_6 = Table(
    6,
    "Input of the place branch, F1max on KITTI",
    "real KITTI",
    KITTI,
    (
        Row("BEV image", (0.934, 0.845, 0.872, 0.942, 0.465, 0.738), 0.799, LEARNED, OWN_RUN),
        Row("true semantic map", (0.955, 0.859, 0.926, 0.975, 0.936, 0.721), 0.895, LEARNED, OWN_RUN),
        Row("BEV image and true semantic map", (0.972, 0.851, 0.936, 0.981, 0.955, 0.762), 0.910, LEARNED, OWN_RUN),
        Row("semantic features", (0.980, 0.918, 0.976, 1.000, 1.000, 0.898), 0.962, LEARNED, OWN_RUN),
    ),
)

TABLE_7 = Table(
    7,
    "Ablation of the losses, F1max on KITTI",
    "real KITTI",
    KITTI,
    (
        Row("triplet loss", (0.932, 0.842, 0.903, 0.975, 0.604, 0.785), 0.840, LEARNED, OWN_RUN),
        Row("triplet loss, cross-entropy", (0.957, 0.906, 0.950, 0.973, 1.000, 0.852), 0.940, LEARNED, OWN_RUN),
        Row("triplet loss, Dice", (0.965, 0.907, 0.950, 0.985, 1.000, 0.809), 0.936, LEARNED, OWN_RUN),
        Row("triplet loss, cross-entropy, Dice", (0.980, 0.918, 0.976, 1.000, 1.000, 0.898), 0.962, LEARNED, OWN_RUN),
    ),
)

TABLES = (TABLE_1, TABLE_2, TABLE_3, TABLE_4, TABLE_5, TABLE_6, TABLE_7)
