"""SG-LPR in a form that follows rotations: the paper's windows, CBAM, convolutions, NetVLAD and joint loss.

Reproduces the network and the losses of the paper (figure 2, equations 5 to 8), but not its sizes. The image is polar,
and circular convolutions make the tokens. CBAM and the convolutions of the head are circular, too
(docs/decisions.md).

Expect: top-1 F1max 0.99, 0.88 and 0.97 to 0.98 on KITTI 00, 02 and 06, after three hours of one core. An earlier
form of this preset, in nine trainings, made the weights of sglpr_jax/weights/sglpr.

Command: bin/train --seq held-out/08 --data TOWNS --preset sglpr, with the TOWNS of bin/simulate --training-set
"""

from sglpr_jax.methods.recipe import TupleConfig
from sglpr_jax.models.config import model_preset
from sglpr_jax.training.config import LossConfig, OptimizerConfig, TrainConfig

CONFIG = TrainConfig(
    model=model_preset("sglpr"),
    sampling=TupleConfig(  # the other places of a step are the negatives
        negatives=0, cluster=5, positive_m=4.0, mining="hardest", refresh_steps=50, mined_places=1000
    ),
    loss=LossConfig(
        margin=0.3,
        squared=True,
        temperature=0.1,
        one_threshold=0.5,
        segment_every=4,
        ignore_unlabelled=True,
        class_balance=0.5,
    ),
    optimizer=OptimizerConfig(
        algorithm="muon", learning_rate=0.02, warmup_steps=20, decay_rate=0.5, decay_steps=900, clip_norm=1.0
    ),
    steps=5000,
    tuples=20,
    share_negatives=True,
    max_points=131072,
    score_every=500,
)
