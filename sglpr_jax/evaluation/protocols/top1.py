"""Protocols of top-1 retrieval: the nearest frame answers each query, and a threshold accepts or rejects the answer."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Int

from sglpr_jax.evaluation.protocols.protocol import (
    Kind,
    Protocol,
    Source,
    TopK,
    near_answers,
    nearest_frames,
    positions_of,
    recall_at,
)
from sglpr_jax.evaluation.protocols.result import Decision, Result, with_f1_max
from sglpr_jax.revisits import Near, database_end, has_near
from sglpr_jax.same_place import EXCLUDED_FRAMES, EXCLUDED_S


@dataclass(frozen=True, kw_only=True)
class Top1(Protocol):
    """Top-1 retrieval with answers that are right or wrong according to their distance in metres.

    The database of a query is the frames that are old enough. A query is a revisit if its database has a right answer.
    An accepted answer is a true positive if it is right, a false positive if it is wrong, else not counted. A rejected
    answer is a false negative for a revisit, else a true negative. Every distinct descriptor distance is a threshold.
    Recall@N is the share of revisits with a right answer among the nearest N frames, without a threshold.
    """

    takes: tuple[Kind, ...] = ("descriptors", "scored top-k list")
    metres: str
    """Distances of right and wrong answers, in words."""
    right: Near
    """Whether an answer at this distance in metres is right."""
    wrong: Near | None = None
    """Whether an answer at this distance in metres is wrong. None: every answer that is not right."""
    gap: int | None = None
    """Gap between query and database in frames, as published. None: 30 s (`revisits.database_end`)."""
    min_age: int = 0
    """Frames of the database are at least this number of frames older than the query. Unused without a gap."""
    last_is_query: bool = True
    first_thresholded: int = 0
    """First query of F1max. Queries of Recall@N begin with the first frame that has a database."""
    numbers: tuple[int, ...] = (1,)
    """The numbers N of Recall@N."""
    one_percent: bool = False
    """Whether Recall@N is also computed for N = 1 % of all frames."""

    def __call__(self, source: Source, *, seed: int = 0) -> Result:
        """Score descriptors or a top-k list with scores. Raises ValueError if positions or scores are missing."""
        if isinstance(source, TopK) and source.scores is None:
            raise ValueError(f"{self.title}: expected a list with scores for the threshold, found no scores")
        n = len(source)
        positions = positions_of(source, self.dimensions)
        ends, excluded = self._databases(source)
        queries = np.flatnonzero(ends)
        numbers = sorted({*self.numbers, max(round(n / 100), 1)} if self.one_percent else self.numbers)
        nearest, distance = nearest_frames(source, queries, ends[queries], k=numbers[-1])
        right = near_answers(positions[queries], positions, nearest, self.right)
        wrong = near_answers(positions[queries], positions, nearest, self.wrong or (lambda metres: ~self.right(metres)))
        revisited = has_near(positions[queries], positions, ends[queries], self.right)
        recalls = recall_at(right[revisited], numbers) if revisited.any() else {}

        # F1max: only the first answer of each query, and only the queries from `first_thresholded` on.
        counted = queries >= self.first_thresholded
        queries, distance, revisited = queries[counted], distance[counted], revisited[counted]
        nearest, right, wrong = nearest[counted, 0], right[counted, 0], wrong[counted, 0]
        result = replace(
            self.new_result(f"{self.metres}, {excluded}", source),
            counts={"queries": len(queries), "revisits": int(revisited.sum())},
            recalls=recalls,
            answers=_fill_frames(n, queries, nearest, default=-1),
            answer_distances=_fill_frames(n, queries, distance, default=np.inf),
        )
        accepted = np.zeros(len(queries), dtype=bool)
        if revisited.any() and not np.isfinite(distance).any():  # no query has an answer
            result = replace(result, score=0.0, interval=(0.0, 0.0))
        elif revisited.any():
            flags = {"true_if_accepted": right, "false_if_accepted": wrong, "missed_if_rejected": revisited}
            result = with_f1_max(result, -distance, query=queries, seed=seed, **flags)
            assert result.curve is not None
            accepted = -distance >= result.curve.thresholds[result.curve.best]
        decisions = np.select(
            [accepted & right, accepted & wrong, accepted, revisited],
            [Decision.TRUE_POSITIVE, Decision.FALSE_POSITIVE, Decision.UNCOUNTED, Decision.FALSE_NEGATIVE],
            Decision.TRUE_NEGATIVE,
        )
        decisions = _fill_frames(n, queries, decisions, default=Decision.NOT_A_QUERY).astype(np.int8)
        return replace(result, decisions=decisions)

    def _databases(self, source: Source) -> tuple[Int[np.ndarray, " n"], str]:
        """Return how many of the first frames are the database of each frame (0: not a query), and the gap in words."""
        if self.gap is None:
            gap = f"{EXCLUDED_FRAMES} frames" if source.times is None else f"{EXCLUDED_S:g} s"
            return database_end(len(source), times=source.times), f"last {gap} excluded"
        ends = np.maximum(np.arange(len(source)) - self.min_age + 1, 0)
        if not self.last_is_query:
            ends[-1] = 0
        return ends, f"gap {self.gap} frames"


def _fill_frames(n: int, queries: Int[np.ndarray, " q"], values: np.ndarray, *, default: int | float) -> np.ndarray:
    """Return an array of n frames with the value of each query, and the default for frames that are no queries."""
    frames = np.full(n, default)
    frames[queries] = values
    return frames


TOP1_F1MAX = Top1(
    name="top1-f1max",
    title="top-1 F1max",
    rule="the nearest frame at least 30 s older: right up to 3 m, wrong beyond 20 m, in 3-D",
    source="LoGG3D-Net, evaluation/eval_sequence.py; Locus",
    published_on="SemanticKITTI's poses",
    dimensions=3,
    metres="3 m / 20 m",
    right=lambda metres: metres <= 3,
    wrong=lambda metres: metres > 20,
    headline=True,
)
"""The published code uses 1000 thresholds (Locus: 200)."""

SCAN_CONTEXT_F1MAX = Top1(
    name="scan-context-f1max",
    title="Scan Context F1max",
    rule="the nearest frame at least 49 older: right below 5 m in x and y, else wrong",
    source="Scan Context, fast_evaluator/main.m",
    published_on="Scan Context's own pose files",
    dimensions=2,
    metres="5 m",
    right=lambda metres: metres < 5,
    gap=50,
    min_age=49,
    last_is_query=False,
)
"""The gap in the published code (gisbi-kim/scancontext) includes the query, and the oldest frame of the gap is in the
database. That code compares 50 candidates, chosen by ring key, at 100 thresholds. Here all frames are compared."""

CONTOUR_CONTEXT_F1MAX = Top1(
    name="contour-context-f1max",
    title="Contour Context F1max",
    rule="the nearest frame more than 150 older: right below 5 m in 3-D, else wrong",
    source="Contour Context, scripts/pr_mpe.py",
    published_on="Contour Context's own sensor poses",
    dimensions=3,
    metres="5 m",
    right=lambda metres: metres < 5,
    gap=150,
    min_age=151,
)
"""The published code (lewisjiang/contour-context) applies the gap only to false negatives and expects the method to
answer with older frames. The published scores are of KITTI 08."""

OVERLAP_TRANSFORMER_F1MAX = Top1(
    name="overlap-transformer-f1max",
    title="OverlapTransformer F1max",
    rule="the nearest frame more than 100 older: right where the scans overlap by more than 0.3, else wrong",
    source="OverlapTransformer, test/test_kitti00_PR.py",
    published_on="overlaps, from KITTI 00's poses",
    dimensions=2,
    metres="15 m in place of overlaps",
    right=lambda metres: metres < 15,
    gap=100,
    min_age=101,
    last_is_query=False,
    first_thresholded=150,
    numbers=(1, 5, 10, 20),
    one_percent=True,
)
"""The published code uses overlaps of range images and 10,000 thresholds up to a squared distance of 1. Here an answer
within 15 m is right, as in CVTNet by the same authors. The score therefore differs from the published one."""
