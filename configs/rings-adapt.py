"""Adaptation of weights from the simulator to real images without labels: `rings`, trained on for some minutes.

Reproduces no result of the paper. It answers the second open question of its conclusion: semantics without labels. The
model learns places on real images, and places and semantics on simulated images with labels (docs/guides/training.md).

Expect: on the KITTI BEV images, trained on 00 and 02, whitened on them (`bin/export --whiten`) and tested on 06: top-1
F1max .981, Recall@1 .993; rotated .985 and .993 (one seed). The 240 steps take four to five minutes on one CPU core.

Command: bin/train --seq 06 --data KITTI_BEV --also SIMULATED --weights rings --preset rings-adapt
"""

from sglpr_jax.data.sampling.config import TupleConfig
from sglpr_jax.models.presets import model_preset
from sglpr_jax.training.config import LossConfig, OptimizerConfig, TrainConfig

CONFIG = TrainConfig(
    model=model_preset("rings"),
    sampling=TupleConfig(negatives=0, cluster=4, positive_m=4.0),  # the batch's other places are the negatives
    loss=LossConfig(
        margin=0.3,
        squared=True,
        temperature=0.1,
        one_threshold=0.5,
        segment_every=10,  # places of the second source, which have labels
        ignore_unlabelled=True,
        class_balance=0.5,
    ),
    optimizer=OptimizerConfig(learning_rate=5e-4, warmup_steps=20, decay_rate=0.5, decay_steps=55, clip_norm=1.0),
    steps=240,
    tuples=20,
    also_tuples=6,
    also_triplets=True,
    share_negatives=True,
    max_points=131072,
    score_every=120,
)
