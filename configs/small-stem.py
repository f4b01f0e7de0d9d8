"""The preset `small` with convolutions in front: places and a better semantic map, for two CPU cores.

Reproduces no result of the paper. A step has few images, and all of them are segmented. docs/decisions/models.md has
the reasons.

Expect: after 4278 of the 6000 steps (67 minutes on two CPU cores), a mean IoU above .22 on a simulated recording that
was not used in training. Predicting the most common class everywhere gives .02.

Command: bin/train --seq 08 --data TOWNS --preset small-stem
"""

from sglpr_jax.data.sampling.config import TupleConfig
from sglpr_jax.models.presets import model_preset
from sglpr_jax.training.config import LossConfig, OptimizerConfig, TrainConfig

CONFIG = TrainConfig(
    model=model_preset("small-stem"),
    sampling=TupleConfig(negatives=0),  # the batch's other places are the negatives
    loss=LossConfig(margin=0.3, squared=True, temperature=0.1, ignore_unlabelled=True, class_balance=0.5),
    optimizer=OptimizerConfig(learning_rate=6e-4, warmup_steps=300, decay_rate=0.5, decay_steps=1300, clip_norm=1.0),
    steps=6000,
    tuples=5,
    share_negatives=True,
    max_points=131072,
    score_every=500,
)
"""With a learning rate of 1e-3 and 100 warm-up steps, the descriptors collapsed to one point."""
