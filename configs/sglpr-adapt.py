"""From weights of the simulator to real images without labels: `sglpr`, trained on for some minutes.

Reproduces nothing of the paper; it is `rings-adapt` with SG-LPR's network, half of the learning rate and half of the
tuples simulated: places are learnt on real images, places and semantics on simulated ones (docs/guides/training.md).

Expect: on the KITTI BEV images, trained on 00 and 02, whitened on them and tested on 06: top-1 F1max .991, pairs F1max
.911, Recall@1 1.000; rotated .987, .898 and .996 (one seed). The 240 steps take two to three minutes of one CPU core.

Command: bin/train --seq 06 --data KITTI_BEV --also SIMULATED --weights sglpr --preset sglpr-adapt
"""

from sglpr_jax.data.sampling.tuples import TupleConfig
from sglpr_jax.models.presets import model_preset
from sglpr_jax.training.config import LossConfig, OptimizerConfig, TrainConfig

CONFIG = TrainConfig(
    model=model_preset("sglpr"),
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
    optimizer=OptimizerConfig(learning_rate=3e-4, warmup_steps=20, decay_rate=0.5, decay_steps=55, clip_norm=1.0),
    steps=240,
    tuples=20,
    also_tuples=10,
    also_triplets=True,
    share_negatives=True,
    max_points=131072,
    score_every=120,
)
