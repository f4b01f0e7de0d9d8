"""Protocol of BEVPlace on one recording: Recall@N on a fixed split."""

from sglpr_jax.evaluation.protocols.bevplace_split import V1_SPLITS, recall_on_split
from sglpr_jax.evaluation.protocols.protocol import RETRIEVAL, Protocol
from sglpr_jax.evaluation.protocols.result import Result
from sglpr_jax.evaluation.protocols.source import Source


def bevplace_v1_recall(source: Source, *, seed: int = 0) -> Result:
    """Score Recall@1, 5, 10 and 20 on BEVPlace's split, as `bevplace_recall_at_1` but with 5 m in x and y.

    Published on the LiDAR-frame poses that come with the images (zjuluolun/BEVPlace). The interval of Recall@1
    resamples the queries that count.
    """
    name, numbers = "BEVPlace v1 Recall@1", (1, 5, 10, 20)
    return recall_on_split(source, name, "BEVPlace", V1_SPLITS, dimensions=2, numbers=numbers, seed=seed)


BEVPLACE_V1_RECALL = Protocol(
    "bevplace-v1-recall",
    bevplace_v1_recall,
    rule="Recall@1, 5, 10 and 20 of a later part of the recording in its first part: less than 5 m in x and y",
    source="BEVPlace",
    takes=RETRIEVAL,
    returns="recall",
)
