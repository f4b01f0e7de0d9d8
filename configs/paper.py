"""SG-LPR as printed: the model of table 1 and its training, on KITTI, leave-one-out.

Reproduces table 1: top-1 F1max .980 .918 .976 1.000 1.000 .898 on 00 02 05 06 07 08, mean .962. The paper does not
define margin, distance, decay of the learning rate and place head. docs/decisions.md explains their values.

Expect: these numbers were not measured here. The 200,000 steps require a GPU: a step takes nine seconds on a CPU core.

Command: bin/train --seq 08 --data KITTI --preset paper
"""

from sglpr_jax.models.config import model_preset
from sglpr_jax.training.config import OptimizerConfig, TrainConfig

CONFIG = TrainConfig(
    model=model_preset("paper"),
    optimizer=OptimizerConfig(learning_rate=1e-5, decay_rate=0.99, decay_steps=1000, staircase=True),
    steps=200_000,
    tuples=1,
    chunk=2,
    score_every=2000,
)
