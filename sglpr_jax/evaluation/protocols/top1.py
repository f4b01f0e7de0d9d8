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

    A query is a revisit if a frame of its database would be a right answer. An accepted answer is a true positive if it
    is right, a false positive if it is wrong, else not counted. A rejected answer is a false negative for a revisit,
    else a true negative. Every distinct distance is a threshold. The interval resamples queries. Recall@N is the share
    of revisits with a right answer among the nearest N frames, without a threshold.
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
    """Whether 1 % of all frames is one more number N."""

    def __call__(self, source: Source, *, seed: int = 0) -> Result:
        """Score descriptors or a top-k list with scores. Raises ValueError if positions or scores are missing."""
        if isinstance(source, TopK) and source.scores is None:
            raise ValueError(f"{self.title}: expected a list with scores for the threshold, found no scores")
        n, positions, (ends, excluded) = len(source), positions_of(source, self.dimensions), self._databases(source)
        queries = np.flatnonzero(ends)
        numbers = sorted({*self.numbers, max(round(n / 100), 1)} if self.one_percent else self.numbers)
        nearest, distance = nearest_frames(source, queries, ends[queries], k=numbers[-1])
        is_wrong = self.wrong or (lambda apart: ~self.right(apart))
        right, wrong = (near_answers(positions[queries], positions, nearest, near) for near in (self.right, is_wrong))
        revisited = has_near(positions[queries], positions, ends[queries], self.right)
        recalls = recall_at(right[revisited], numbers) if revisited.any() else {}

        late = queries >= self.first_thresholded
        queries, distance, revisited = queries[late], distance[late], revisited[late]
        nearest, right, wrong = (columns[late, 0] for columns in (nearest, right, wrong))
        answers, distances = np.full(n, -1, dtype=np.int64), np.full(n, np.inf)
        answers[queries], distances[queries] = nearest, distance
        result = replace(
            self.result(f"{self.metres}, {excluded}", source),
            counts={"queries": len(queries), "revisits": int(revisited.sum())},
            recalls=recalls,
            answers=answers,
            answer_distances=distances,
        )
        accepted = np.zeros(len(queries), dtype=bool)
        if revisited.any() and not np.isfinite(distance).any():
            result = replace(result, score=0.0, interval=(0.0, 0.0))
        elif revisited.any():
            flags = {"true_if_accepted": right, "false_if_accepted": wrong, "missed_if_rejected": revisited}
            result = with_f1_max(result, -distance, query=queries, seed=seed, **flags)
            assert result.curve is not None
            accepted = -distance >= result.curve.thresholds[result.curve.best]
        decisions = np.full(n, Decision.NOT_A_QUERY, dtype=np.int8)
        decisions[queries] = np.select(
            [accepted & right, accepted & wrong, accepted, revisited],
            [Decision.TRUE_POSITIVE, Decision.FALSE_POSITIVE, Decision.UNCOUNTED, Decision.FALSE_NEGATIVE],
            Decision.TRUE_NEGATIVE,
        )
        return replace(result, decisions=decisions)

    def _databases(self, source: Source) -> tuple[Int[np.ndarray, " n"], str]:
        """Return the number of first frames that are the database of each frame (0: no query), and the gap in words."""
        if self.gap is None:
            last = f"{EXCLUDED_FRAMES} frames" if source.times is None else f"{EXCLUDED_S:g} s"
            return database_end(len(source), times=source.times), f"last {last} excluded"
        ends = np.maximum(np.arange(len(source)) - self.min_age + 1, 0)
        if not self.last_is_query:
            ends[-1] = 0
        return ends, f"gap {self.gap} frames"


TOP1_F1MAX = Top1(
    name="top1-f1max",
    title="top-1 F1max",
    rule="the nearest frame at least 30 s older: right up to 3 m, wrong beyond 20 m, in 3-D",
    source="LoGG3D-Net, evaluation/eval_sequence.py; Locus",
    published_on="SemanticKITTI's poses",
    dimensions=3,
    metres="3 m / 20 m",
    right=lambda apart: apart <= 3,
    wrong=lambda apart: apart > 20,
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
    right=lambda apart: apart < 5,
    gap=50,
    min_age=49,
    last_is_query=False,
)
"""The gap of the published code (gisbi-kim/scancontext) includes the query, and the oldest of its frames is in the
database. That code compares 50 candidates chosen by ring key, at 100 thresholds; here all frames are compared."""

CONTOUR_CONTEXT_F1MAX = Top1(
    name="contour-context-f1max",
    title="Contour Context F1max",
    rule="the nearest frame more than 150 older: right below 5 m in 3-D, else wrong",
    source="Contour Context, scripts/pr_mpe.py",
    published_on="Contour Context's own sensor poses",
    dimensions=3,
    metres="5 m",
    right=lambda apart: apart < 5,
    gap=150,
    min_age=151,
)
"""The published code (lewisjiang/contour-context) applies the gap only to false negatives and expects the method to
answer with older frames. Its numbers are of KITTI 08."""

OVERLAP_TRANSFORMER_F1MAX = Top1(
    name="overlap-transformer-f1max",
    title="OverlapTransformer F1max",
    rule="the nearest frame more than 100 older: right where the scans overlap by more than 0.3, else wrong",
    source="OverlapTransformer, test/test_kitti00_PR.py",
    published_on="overlaps, from KITTI 00's poses",
    dimensions=2,
    metres="15 m in place of overlaps",
    right=lambda apart: apart < 15,
    gap=100,
    min_age=101,
    last_is_query=False,
    first_thresholded=150,
    numbers=(1, 5, 10, 20),
    one_percent=True,
)
"""The published code uses overlaps of range images and 10,000 thresholds up to a squared distance of 1. The 15 m in
place of the overlaps are those of CVTNet, by the same authors, so the score is not the published one."""
