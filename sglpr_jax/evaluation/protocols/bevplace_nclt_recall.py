"""Protocol of BEVPlace++ across sessions: Recall@1 of one session in another."""

import numpy as np

from sglpr_jax.evaluation.protocols.bevplace_split import POSITIVE_M, near
from sglpr_jax.evaluation.protocols.nearest import first_hits, nearest_descriptors
from sglpr_jax.evaluation.protocols.protocol import Protocol
from sglpr_jax.evaluation.protocols.recall import score_recall
from sglpr_jax.evaluation.protocols.result import Result
from sglpr_jax.evaluation.protocols.source import pose_sources, positions_of
from sglpr_jax.retrieval.descriptor_file import DescriptorFile, check_same_method
from sglpr_jax.revisits import has_near


def bevplace_nclt_recall(database: DescriptorFile, queries: DescriptorFile, *, seed: int = 0) -> Result:
    """Score Recall@1 across two sessions as BEVPlace++ does on NCLT: 5 m in x and y.

    All frames of one session are the database, and all frames of the other are queries. A query counts if the
    database has a frame less than 5 m away. It is found if the frame of the nearest descriptor is less than 5 m
    away. The published scores use NCLT's ground-truth poses, with 2012-01-15 as the database, and 2012-02-04,
    03-17, 06-15, 09-28, 11-16 and 2013-02-23 as queries (zjuluolun/BEVPlace2, nclt_dataset.py). The frames used
    there are not published. The interval resamples the queries that count.
    """
    check_same_method(database, queries)
    there, here = positions_of(database, 2), positions_of(queries, 2)
    ends = np.full(len(here), len(there))
    nearest, _ = nearest_descriptors(queries.descriptors, database.descriptors, ends, distance=database.distance)
    result = Result(
        name="NCLT Recall@1",
        rule=f"{POSITIVE_M:g} m, database {database.sequence}, queries {queries.sequence}",
        dimensions=2,
        pose_source=pose_sources(database, queries),
        published_on="NCLT's ground truth",
    )
    return score_recall(result, first_hits(here, there, nearest, near), has_near(here, there, ends, near), seed=seed)


BEVPLACE_NCLT_RECALL = Protocol(
    "bevplace-nclt-recall",
    bevplace_nclt_recall,
    rule="Recall@1 of one session in another: less than 5 m in x and y",
    source="BEVPlace++, nclt_dataset.py",
    takes=("sessions",),
    returns="recall",
)
