"""The protocols of BEVPlace and BEVPlace++: Recall on a fixed split of a sequence, and across sessions."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sglpr_jax.evaluation.protocols.nearest import first_hits, has_near, nearest_descriptors, nearest_frames
from sglpr_jax.evaluation.protocols.recall import recall_decisions, score_recall
from sglpr_jax.evaluation.protocols.result import Result
from sglpr_jax.evaluation.protocols.source import Source, check_comparable, pose_sources, positions_of
from sglpr_jax.retrieval.descriptor_file import DescriptorFile

POSITIVE_M = 5.0
FRAMES = {"00": 4541, "02": 4661, "05": 2761, "06": 1101, "08": 4071}
"""How many frames a KITTI sequence has: a sequence of another length is another sequence."""
SPLITS = {
    "00": (3000, 3200, 4541),
    "02": (3400, 3600, 4661),
    "05": (1000, 1200, 2761),
    "06": (600, 800, 1101),
    "08": (1000, 1200, 4071),
}
"""BEVPlace++: where the map ends, where the queries start and where they end."""
V1_SPLITS = {"00": SPLITS["00"], "02": SPLITS["02"], "05": (1000, 1200, 2751), "06": SPLITS["06"]}
"""BEVPlace: ten queries fewer in 05, and no 08."""
MAP_SHARE = 0.6
"""The part of any other sequence that is the map."""


def bevplace_recall_at_1(source: Source, *, seed: int = 0) -> Result:
    """Score Recall@1 on BEVPlace++'s split: the first part of the sequence is the map, 5 m in 3-D.

    A query counts if the map has a frame less than 5 m away; it is found if the nearest descriptor is such a frame. The
    split is the published one where name and number of frames are those of a KITTI sequence that has one. Elsewhere the
    map is the first 60 % of the frames and the rest are queries, without a gap between them. Published on the
    LiDAR-frame poses that come with the images (zjuluolun/BEVPlace2, kitti_dataset.py); of sequence 08 the published
    code takes every fifth frame, here all count. The interval resamples the queries that count.
    """
    return _on_split(source, "Recall@1", "BEVPlace++", SPLITS, dimensions=3, numbers=(1,), seed=seed)


def bevplace_v1_recall(source: Source, *, seed: int = 0) -> Result:
    """Score Recall@1, 5, 10 and 20 on BEVPlace's split: as `bevplace_recall_at_1`, but 5 m in x and y.

    Published on the LiDAR-frame poses that come with the images (zjuluolun/BEVPlace). The interval of Recall@1
    resamples the queries that count.
    """
    numbers = (1, 5, 10, 20)
    return _on_split(source, "BEVPlace v1 Recall@1", "BEVPlace", V1_SPLITS, dimensions=2, numbers=numbers, seed=seed)


def bevplace_nclt_recall(database: DescriptorFile, queries: DescriptorFile, *, seed: int = 0) -> Result:
    """Score Recall@1 across two sessions as BEVPlace++ does on NCLT: 5 m in x and y.

    All frames of one session are the map, all of the other are queries. A query counts if the map has a frame less than
    5 m away; it is found if the nearest descriptor is such a frame. Published on NCLT's ground truth with 2012-01-15 as
    the map, and 2012-02-04, 03-17, 06-15, 09-28, 11-16 and 2013-02-23 as queries (zjuluolun/BEVPlace2,
    nclt_dataset.py); which frames were taken is not published. The interval resamples the queries that count.
    """
    check_comparable(database, queries)
    there, here = positions_of(database, 2), positions_of(queries, 2)
    ends = np.full(len(here), len(there))
    nearest, _ = nearest_descriptors(queries.descriptors, database.descriptors, ends, distance=database.distance)
    result = Result(
        name="NCLT Recall@1",
        rule=f"{POSITIVE_M:g} m, map {database.sequence}, queries {queries.sequence}",
        dimensions=2,
        pose_source=pose_sources(database, queries),
        published_on="NCLT's ground truth",
    )
    return score_recall(result, first_hits(here, there, nearest, _near), has_near(here, there, ends, _near), seed=seed)


def _on_split(
    source: Source,
    name: str,
    paper: str,
    splits: dict[str, tuple[int, int, int]],
    *,
    dimensions: int,
    numbers: Sequence[int],
    seed: int,
) -> Result:
    positions = positions_of(source, dimensions)
    map_end, first, last, split = _split(source, paper, splits)
    queries, ends = np.arange(first, last), np.full(last - first, map_end)
    result = Result(
        name=name,
        rule=f"{POSITIVE_M:g} m, {split}",
        dimensions=dimensions,
        pose_source=source.pose_source,
        published_on="the poses of BEVPlace's images",
    )
    revisited = has_near(positions[queries], positions, ends, _near)
    ranks = np.full(len(queries), numbers[-1])
    if revisited.any():
        nearest, _ = nearest_frames(source, queries, ends, k=numbers[-1])
        ranks = first_hits(positions[queries], positions, nearest, _near)
    result = score_recall(result, ranks, revisited, numbers=numbers, seed=seed)
    return replace(result, decisions=recall_decisions(len(source), queries, ranks, revisited))


def _split(source: Source, paper: str, splits: dict[str, tuple[int, int, int]]) -> tuple[int, int, int, str]:
    """Return how many frames are the map, the first query, the end of the queries, and the split in words."""
    n = len(source)
    if source.sequence in splits and FRAMES[source.sequence] == n:
        map_end, first, last = splits[source.sequence]
        return map_end, first, last, f"{paper} split: map 0 to {map_end - 1}, queries {first} to {last - 1}"
    map_end = int(MAP_SHARE * n)
    return map_end, map_end, n, f"no published split: map is the first {MAP_SHARE:.0%} of the frames"


def _near(apart: np.ndarray) -> np.ndarray:
    return apart < POSITIVE_M
