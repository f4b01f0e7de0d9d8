"""The small model, for two CPU cores: place recognition within the hour.

Reproduces nothing of the paper; it is the paper's network made small, with the image in polar form and other places of
the batch as further negatives (docs/decisions.md has the reasons, docs/results.md the measurements).

Expect: on the KITTI BEV images, trained on 00 and 02 and tested on 06, see docs/results.md.
Command: bin/train --seq 06 --data KITTI_BEV --preset small
"""

from sglpr_jax.data.tuples import TupleConfig
from sglpr_jax.models.presets import model_preset
from sglpr_jax.train.config import LossConfig, OptimizerConfig, TrainConfig

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
