"""From weights of the simulator to real images without labels: `rings`, trained on for some minutes.

Reproduces nothing of the paper; it answers its second open question, semantics without labels: places are learnt on
real images, and on simulated ones with label maps places and semantics (docs/training.md, docs/results.md).

Expect: on the KITTI BEV images, leave-one-out, see docs/results.md.
Command: bin/train --seq 06 --data KITTI_BEV --also SIMULATED --start simulated --preset rings-adapt
"""

from sglpr_jax.data.tuples import TupleConfig
from sglpr_jax.models.presets import model_preset
from sglpr_jax.train.config import LossConfig, OptimizerConfig, TrainConfig

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
