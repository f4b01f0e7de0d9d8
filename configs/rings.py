"""Convolutions that turn with the scan, in place of the Swin-Unet: more accurate than `small` after less computation.

Reproduces nothing of the paper; it answers its first open question, a descriptor that does not move when the scan is
turned (docs/decisions.md has the reasons, docs/results.md the measurements).

Expect: on the KITTI BEV images, leave-one-out, see docs/results.md.
Command: bin/train --seq 06 --data KITTI_BEV --preset rings
"""

from sglpr_jax.data.tuples import TupleConfig
from sglpr_jax.models.presets import model_preset
from sglpr_jax.train.config import LossConfig, OptimizerConfig, TrainConfig

CONFIG = TrainConfig(
    model=model_preset("rings"),
    sampling=TupleConfig(negatives=0),  # the batch's other places are the negatives
    loss=LossConfig(
        margin=0.3,
        squared=True,
        temperature=0.1,
        one_threshold=0.5,
        segment_every=2,
        ignore_unlabelled=True,
        class_balance=0.5,
    ),
    optimizer=OptimizerConfig(learning_rate=1e-3, warmup_steps=50, decay_rate=0.5, decay_steps=300, clip_norm=1.0),
    steps=1500,
    tuples=20,
    share_negatives=True,
    max_points=131072,
    score_every=500,
)
