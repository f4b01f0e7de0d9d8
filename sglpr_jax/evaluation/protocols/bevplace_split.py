"""Split of a recording by BEVPlace and BEVPlace++: the first part is the database, a later part the queries."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from sglpr_jax.evaluation.protocols.nearest import first_hits, nearest_frames
from sglpr_jax.evaluation.protocols.recall import recall_decisions, score_recall
from sglpr_jax.evaluation.protocols.result import Result
from sglpr_jax.evaluation.protocols.source import Source, positions_of
from sglpr_jax.revisits import has_near

POSITIVE_M = 5.0
"""Distance below which two frames show the same place, in metres."""
FRAMES = {"00": 4541, "02": 4661, "05": 2761, "06": 1101, "08": 4071}
"""Number of frames of each KITTI sequence. The published splits apply only to recordings of this length."""
SPLITS = {
    "00": (3000, 3200, 4541),
    "02": (3400, 3600, 4661),
    "05": (1000, 1200, 2761),
    "06": (600, 800, 1101),
    "08": (1000, 1200, 4071),
}
"""BEVPlace++: end of the database, start of the queries and end of the queries, by sequence."""
V1_SPLITS = {"00": SPLITS["00"], "02": SPLITS["02"], "05": (1000, 1200, 2751), "06": SPLITS["06"]}
"""BEVPlace: the same without 08 and with ten queries fewer in 05."""
DATABASE_SHARE = 0.6
"""Fraction of the frames that is the database, for other recordings."""
SEAM_M = 20.0
"""Distance between the last frame of the database and the first query, in metres, for other recordings.

Closer frames are neighbours, not revisits. The published splits skip 200 frames, which are too many for a short
recording.
"""


def recall_on_split(
    source: Source,
    name: str,
    paper: str,
    splits: Mapping[str, tuple[int, int, int]],
    *,
    dimensions: int,
    numbers: Sequence[int],
    seed: int,
) -> Result:
    """Score Recall@N with the first frames of a recording as the database and later frames as queries.

    Arguments:
      source: Descriptors or a top-k list.
      name: Name of the result.
      paper: Name of the method that published the splits.
      splits: End of the database, start of the queries and end of the queries, by sequence.
      dimensions: Dimensions of the distances between frames, 2 or 3.
      numbers: The numbers N, increasing.
      seed: Seed of the bootstrap interval.
    """
    positions = positions_of(source, dimensions)
    end, first, last, split = _split(source, positions, paper, splits)
    queries, ends = np.arange(first, last), np.full(last - first, end)
    result = Result(
        name=name,
        rule=f"{POSITIVE_M:g} m, {split}",
        dimensions=dimensions,
        pose_source=source.pose_source,
        published_on="the poses of BEVPlace's images",
    )
    revisited = has_near(positions[queries], positions, ends, near)
    ranks = np.full(len(queries), numbers[-1])
    if revisited.any():
        nearest, _ = nearest_frames(source, queries, ends, k=numbers[-1])
        ranks = first_hits(positions[queries], positions, nearest, near)
    result = score_recall(result, ranks, revisited, numbers=numbers, seed=seed)
    return replace(result, decisions=recall_decisions(len(source), queries, ranks, revisited))


def _split(
    source: Source,
    positions: Float[np.ndarray, "n _"],
    paper: str,
    splits: Mapping[str, tuple[int, int, int]],
) -> tuple[int, int, int, str]:
    """Return the end of the database, the start and the end of the queries, and the split in words."""
    n = len(source)
    if source.sequence in splits and FRAMES[source.sequence] == n:
        end, first, last = splits[source.sequence]
        return end, first, last, f"{paper} split: database 0 to {end - 1}, queries {first} to {last - 1}"
    end = max(int(DATABASE_SHARE * n), 1)
    apart = np.linalg.norm(positions[end:] - positions[end - 1], axis=1)
    first = end + int(next(iter(np.flatnonzero(apart >= SEAM_M)), n - end))
    database = f"database is the first {DATABASE_SHARE:.0%} of the frames"
    return end, first, n, f"no published split: {database}, queries begin {SEAM_M:g} m from its end"


def near(apart: Float[np.ndarray, "..."]) -> Bool[np.ndarray, "..."]:
    """Return whether frames at these distances, in metres, show the same place."""
    return apart < POSITIVE_M
