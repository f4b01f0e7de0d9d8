"""Protocols of top-1 retrieval: the nearest frame answers each query, and a threshold accepts or rejects the answer."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int, Int8

from sglpr_jax import metrics
from sglpr_jax.evaluation.protocols.bootstrap import f1_max_interval
from sglpr_jax.evaluation.protocols.pairs import frame_pairs
from sglpr_jax.evaluation.protocols.protocol import SCORED_RETRIEVAL, Decision, Protocol, Result
from sglpr_jax.evaluation.protocols.recall import recall_at
from sglpr_jax.evaluation.protocols.source import (
    Kind,
    Source,
    TopK,
    check_frames,
    first_true,
    nearest_frames,
    positions_of,
)
from sglpr_jax.revisits import Near, database_end, has_near
from sglpr_jax.same_place import EXCLUDED_FRAMES, EXCLUDED_S


@dataclass(frozen=True, eq=False)
class Answers:
    """Answers to q queries and their labels according to a protocol."""

    queries: Int[np.ndarray, " q"]
    """Frames of the queries."""
    nearest: Int[np.ndarray, " q"]
    """Frame of each answer, -1 without an answer."""
    distance: Float[np.ndarray, " q"]
    """Descriptor distance of each answer, infinite without an answer."""
    right: Bool[np.ndarray, " q"]
    """Whether the answer is a true positive once accepted."""
    wrong: Bool[np.ndarray, " q"]
    """Whether the answer is a false positive once accepted. Accepted answers that are neither are not counted."""
    revisited: Bool[np.ndarray, " q"]
    """Whether the database has a right answer. If so, a rejected query is a false negative."""


@dataclass(frozen=True, kw_only=True)
class Top1(Protocol):
    """Top-1 retrieval with answers that are right or wrong according to their distance in metres.

    A query is a revisit if a frame of its database would be a right answer. An accepted answer is a true positive if it
    is right, a false positive if it is wrong, else not counted. A rejected answer is a false negative for a revisit,
    else a true negative. Every distinct distance is a threshold. The interval resamples queries.
    """

    takes: tuple[Kind, ...] = SCORED_RETRIEVAL
    metres: str
    """Distances of right and wrong answers, in words."""
    right: Near
    """Whether an answer at this distance in metres is right."""
    wrong: Near
    """Whether an answer at this distance in metres is wrong."""
    gap: int | None = None
    """Gap between query and database in frames, as published. None: 30 s (`revisits.database_end`)."""
    min_age: int = 0
    """Frames of the database are at least this number of frames older than the query. Unused without a gap."""
    last_is_query: bool = True

    def __call__(self, source: Source, *, seed: int = 0) -> Result:
        """Score descriptors or a top-k list with scores. Raises ValueError if positions or scores are missing."""
        positions, ends = positions_of(source, self.dimensions), self._database_end(source)
        queries = np.flatnonzero(ends)
        nearest, distance = nearest_frames(source, queries, ends[queries])
        apart = np.linalg.norm(positions[queries] - positions[nearest[:, 0]], axis=1)
        answered = nearest[:, 0] >= 0
        revisited = has_near(positions[queries], positions, ends[queries], self.right)
        right, wrong = self.right(apart) & answered, self.wrong(apart) & answered
        answers = Answers(queries, nearest[:, 0], distance, right, wrong, revisited)
        return _score(source, self.result(f"{self.metres}, {self._excluded(source)}", source), answers, seed=seed)

    def _database_end(self, source: Source) -> Int[np.ndarray, " n"]:
        """Return, for each frame, the number of first frames that are its database. A frame with 0 is no query."""
        if self.gap is None:
            return database_end(len(source), times=source.times)
        ends = older_by(len(source), self.min_age)
        if not self.last_is_query:
            ends[-1] = 0
        return ends

    def _excluded(self, source: Source) -> str:
        """Describe the frames that are excluded from the database."""
        if self.gap is not None:
            return f"gap {self.gap} frames"
        return f"last {EXCLUDED_FRAMES} frames excluded" if source.times is None else f"last {EXCLUDED_S:g} s excluded"


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
    wrong=lambda apart: apart >= 5,
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
    wrong=lambda apart: apart >= 5,
    gap=150,
    min_age=151,
)
"""The published code (lewisjiang/contour-context) applies the gap only to false negatives and expects the method to
answer with older frames. Its numbers are of KITTI 08."""


@dataclass(frozen=True, kw_only=True)
class OverlapTop1(Protocol):
    """Top-1 retrieval and Recall@N of OverlapTransformer: an answer is right if the range images overlap.

    The database of frame i is frames 0 to i - 101. The last frame is not a query. Queries of F1max begin at frame 150.
    Accepted answers without an overlap are false positives. Recall@1, 5, 10, 20 and 1 % of all frames are over all
    queries with an overlapping frame. Every distinct distance is a threshold; the published code uses 10,000 thresholds
    up to a squared distance of 1.
    """

    takes: tuple[Kind, ...] = SCORED_RETRIEVAL
    gap: int = 100
    """Frames of the database are more than this number of frames older than the query."""
    first_thresholded: int = 150
    """First query of F1max. Queries of Recall@N begin with the first frame that has a database."""
    stand_in_m: float = 15.0
    """Distance that replaces missing overlaps, in metres. The same authors use it in CVTNet."""
    numbers: tuple[int, ...] = (1, 5, 10, 20)

    def __call__(
        self, source: Source, overlapping: Int[np.ndarray, "listed 2"] | None = None, *, seed: int = 0
    ) -> Result:
        """Score descriptors or a top-k list with scores.

        Arguments:
          source: Descriptors or a top-k list with scores.
          overlapping: Pairs (query, older frame) whose range images overlap by more than 0.3. If None, frames less
            than 15 m apart in x and y replace them. The result is then not the published score.
          seed: Seed of the bootstrap interval.
        """
        n = len(source)
        ends = older_by(n, self.gap + 1)
        ends[-1] = 0
        queries = np.flatnonzero(ends)
        overlaps, rule = self._overlaps(source, overlapping)
        result = self.result(f"{rule}, gap {self.gap} frames", source)
        if overlapping is not None:
            result = replace(result, dimensions=None, pose_source=None)
        revisited = np.isin(queries, overlaps // n)
        numbers = sorted({*self.numbers, max(round(n / 100), 1)})
        nearest, distance = nearest_frames(source, queries, ends[queries], k=numbers[-1])
        right = np.isin(queries[:, None] * n + nearest, overlaps) & (nearest >= 0)
        if revisited.any():
            result = replace(result, recalls=recall_at(first_true(right)[revisited], numbers))
        late, answered = queries >= self.first_thresholded, nearest[:, 0] >= 0
        flags = right[:, 0], ~right[:, 0] & answered, revisited
        answers = Answers(queries[late], nearest[late, 0], distance[late], *(flag[late] for flag in flags))
        return _score(source, result, answers, seed=seed)

    def _overlaps(
        self, source: Source, overlapping: Int[np.ndarray, "listed 2"] | None
    ) -> tuple[Int[np.ndarray, " pairs"], str]:
        """Return pairs (i, j) of a query and a right answer in its database as i * n + j, and the rule in words."""
        if overlapping is None:
            positions = positions_of(source, self.dimensions)
            near = frame_pairs(positions, lambda apart, gap: (apart < self.stand_in_m) & (gap > self.gap))
            return near, f"{self.stand_in_m:g} m in place of overlaps"
        check_frames("overlapping", overlapping, 0, len(source))
        i, j = overlapping[overlapping[:, 0] - overlapping[:, 1] > self.gap].T
        return i * len(source) + j, "overlap above 0.3"


OVERLAP_TRANSFORMER_F1MAX = OverlapTop1(
    name="overlap-transformer-f1max",
    title="OverlapTransformer F1max",
    rule="the nearest frame more than 100 older: right where the scans overlap by more than 0.3, else wrong",
    source="OverlapTransformer, test/test_kitti00_PR.py",
    published_on="overlaps, from KITTI 00's poses",
    dimensions=2,
)


def older_by(n: int, frames: int) -> Int[np.ndarray, " {n}"]:
    """Return, for each of n frames, the number of frames that are at least `frames` older. They are its database."""
    return np.maximum(np.arange(n) - frames + 1, 0)


def _score(source: Source, result: Result, answers: Answers, *, seed: int) -> Result:
    """Complete `result` with counts and decisions and, if there is a revisit, with F1max, its curve and interval.

    Recall@1 is added: the share of revisits with a right answer, without a threshold. Raises ValueError for a top-k
    list without scores.
    """
    if isinstance(source, TopK) and source.scores is None:
        raise ValueError(f"{result.name}: expected a list with scores for the threshold, found no scores")
    queries, revisited = answers.queries, answers.revisited
    decisions = np.full(len(source), Decision.NOT_A_QUERY, dtype=np.int8)
    decisions[queries] = Decision.TRUE_NEGATIVE
    counts = {"queries": len(queries), "revisits": int(revisited.sum())}
    result = replace(result, counts=counts, decisions=decisions, **_whole_sequence(len(source), answers))
    if not revisited.any():
        return result
    flags = {
        "true_if_accepted": answers.right,
        "false_if_accepted": answers.wrong,
        "missed_if_rejected": revisited,
    }
    result = replace(result, recalls={1: float(np.mean(answers.right[revisited]))} | result.recalls)
    decisions[queries] = _decide(np.zeros(len(queries), dtype=bool), answers)
    if not np.isfinite(answers.distance).any():
        return replace(result, score=0.0, interval=(0.0, 0.0))
    curve = metrics.decision_curve(-answers.distance, **flags)
    decisions[queries] = _decide(-answers.distance >= curve.thresholds[curve.best], answers)
    interval = f1_max_interval(-answers.distance, **flags, query=queries, seed=seed)
    return replace(result, score=curve.f1_max, curve=curve, interval=interval)


def _whole_sequence(n: int, answers: Answers) -> dict[str, np.ndarray]:
    """Return answers and distances for every frame, as fields of `Result`."""
    nearest, distance = np.full(n, -1, dtype=np.int64), np.full(n, np.inf)
    nearest[answers.queries], distance[answers.queries] = answers.nearest, answers.distance
    return {"answers": nearest, "answer_distances": distance}


def _decide(accepted: Bool[np.ndarray, " q"], answers: Answers) -> Int8[np.ndarray, " q"]:
    """Return the `Decision` for each query."""
    return np.select(
        [accepted & answers.right, accepted & answers.wrong, accepted, answers.revisited],
        [Decision.TRUE_POSITIVE, Decision.FALSE_POSITIVE, Decision.UNCOUNTED, Decision.FALSE_NEGATIVE],
        Decision.TRUE_NEGATIVE,
    ).astype(np.int8)
