"""Protocol of BEVPlace++ on one recording: Recall@1 on a fixed split."""

from sglpr_jax.evaluation.protocols.bevplace_split import SPLITS, recall_on_split
from sglpr_jax.evaluation.protocols.protocol import RETRIEVAL, Protocol
from sglpr_jax.evaluation.protocols.result import Result
from sglpr_jax.evaluation.protocols.source import Source


def bevplace_recall_at_1(source: Source, *, seed: int = 0) -> Result:
    """Score Recall@1 on BEVPlace++'s split: the first part of the recording is the database, 5 m in 3-D.

    A query counts if the database has a frame less than 5 m away. It is found if the frame of the nearest descriptor is
    less than 5 m away. The published split is used if name and number of frames are those of a KITTI sequence with a
    published split. For other recordings the database is the first 60 % of the frames. Their queries begin at the first
    frame 20 m from the last frame of the database, because frames in between are neighbours and no revisits. Published
    on the LiDAR-frame poses that come with the images (zjuluolun/BEVPlace2, kitti_dataset.py). The published code uses
    every fifth frame of sequence 08. Here all frames are used. The interval resamples the queries that count.
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
