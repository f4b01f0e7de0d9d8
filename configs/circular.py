"""A circular CNN on the polar image, without attention: the cheaper of the two shipped networks.

Reproduces no result of the paper. It answers the first open question of its conclusion: a descriptor that does not
change when the scan is rotated. docs/decisions.md has the reasons, docs/results.md the measurements.

Expect: on the KITTI BEV images, trained on 00 and 02 for 320 steps and tested on 06: top-1 F1max .921, Recall@1 .952;
rotated .919 and .981. The flags of that run were `--sampling.cluster 4 --sampling.positive-m 4 --steps 320
--optimizer.decay-steps 75 --score-every 160`. It took five minutes on one CPU core; at this rate the 1500 steps of the
preset take less than half an hour.

Command: bin/train --seq 06 --data KITTI_BEV --preset circular
"""

from sglpr_jax.methods.recipe import TupleConfig
from sglpr_jax.models.config import model_preset
from sglpr_jax.training.config import LossConfig, OptimizerConfig, TrainConfig

CONFIG = TrainConfig(
    model=model_preset("circular"),
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
