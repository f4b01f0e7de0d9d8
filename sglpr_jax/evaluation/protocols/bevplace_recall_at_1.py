"""The protocol of BEVPlace++ on one recording: Recall@1 on a fixed split."""

from sglpr_jax.evaluation.protocols.bevplace_split import SPLITS, recall_on_split
from sglpr_jax.evaluation.protocols.protocol import RETRIEVAL, Protocol
from sglpr_jax.evaluation.protocols.result import Result
from sglpr_jax.evaluation.protocols.source import Source


def bevplace_recall_at_1(source: Source, *, seed: int = 0) -> Result:
    """Score Recall@1 on BEVPlace++'s split: the first part of the recording is the database, 5 m in 3-D.

    A query counts if the database has a frame less than 5 m away; it is found if the nearest descriptor is such a
    frame. The split is the published one where name and number of frames are those of a KITTI sequence that has one.
    Elsewhere the database is the first 60 % of the frames, and the queries begin where the recording is first 20 m from
    the database's last frame: what lies between are neighbours, and no revisits.
    Published on the LiDAR-frame poses that come with the images (zjuluolun/BEVPlace2, kitti_dataset.py); of sequence 08
    the published code takes every fifth frame, here all count. The interval resamples the queries that count.
    """
    return recall_on_split(source, "Recall@1", "BEVPlace++", SPLITS, dimensions=3, numbers=(1,), seed=seed)


BEVPLACE_RECALL_AT_1 = Protocol(
    "bevplace-recall-at-1",
    bevplace_recall_at_1,
    rule="Recall@1 of a later part of the recording in its first part: less than 5 m in 3-D",
    source="BEVPlace++, kitti_dataset.py",
    takes=RETRIEVAL,
    returns="recall",
    headline=True,
)
