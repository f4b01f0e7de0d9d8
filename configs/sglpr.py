"""SG-LPR in a form that turns with the scan: the paper's windows, CBAM, convolutions and NetVLAD, and its joint loss.

Reproduces the network and the losses of the paper (figure 2, equations 5 to 8), not its sizes: the image is polar,
convolutions that go around see its patches, and CBAM and the head's convolutions go around too
(docs/decisions/models.md).

Expect: on the KITTI BEV images, trained on simulated towns alone, the numbers of sglpr_jax/weights/sglpr/README.md.

Command: bin/train --seq 08 --data TOWNS --preset sglpr
"""

from sglpr_jax.data.sampling.config import TupleConfig
from sglpr_jax.models.presets import model_preset
from sglpr_jax.training.config import LossConfig, OptimizerConfig, TrainConfig

CONFIG = TrainConfig(
    model=model_preset("sglpr"),
    sampling=TupleConfig(negatives=0, cluster=5, positive_m=4.0),  # the batch's other places are the negatives
    loss=LossConfig(
        margin=0.3,
        squared=True,
        temperature=0.1,
        one_threshold=0.5,
        segment_every=4,
        ignore_unlabelled=True,
        class_balance=0.5,
    ),
    optimizer=OptimizerConfig(learning_rate=8e-4, warmup_steps=150, decay_rate=0.5, decay_steps=650, clip_norm=1.0),
    steps=4000,
    tuples=20,
    share_negatives=True,
    max_points=131072,
    score_every=500,
)
