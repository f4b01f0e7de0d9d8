"""The paper's network in a small size, for two CPU cores: place recognition in less than an hour.

Reproduces no result of the paper. The image is polar, and other places of the batch are additional negatives.
docs/decisions/models.md has the reasons, docs/results.md the measurements.

Expect: on the KITTI BEV images, trained on 00 and 02 and tested on 06: top-1 F1max .90, Recall@1 .99; rotated .94 and
.99. The 3000 steps took 40 minutes on two CPU cores. The preset has changed slightly since that run (docs/results.md).

Command: bin/train --seq 06 --data KITTI_BEV --preset small
"""

from sglpr_jax.data.sampling.config import TupleConfig
from sglpr_jax.models.presets import model_preset
from sglpr_jax.training.config import LossConfig, OptimizerConfig, TrainConfig

CONFIG = TrainConfig(
    model=model_preset("small"),
    sampling=TupleConfig(negatives=0),  # the batch's other places are the negatives
    loss=LossConfig(
        margin=0.3, squared=True, temperature=0.1, segment_every=2, ignore_unlabelled=True, class_balance=0.5
    ),
    optimizer=OptimizerConfig(learning_rate=1e-3, warmup_steps=100, decay_rate=0.5, decay_steps=650, clip_norm=1.0),
    steps=3000,
    tuples=20,
    share_negatives=True,
    max_points=131072,
    score_every=500,
)
