"""A network with little computation, for tests and for trying a command: it trains in seconds.

Reproduces no result of the paper.

Expect: 4 steps of 8 images, which train nothing useful.

Command: bin/train --seq 08 --preset tiny
"""

from sglpr_jax.methods.recipe import TupleConfig
from sglpr_jax.models.config import model_preset
from sglpr_jax.training.config import OptimizerConfig, TrainConfig

CONFIG = TrainConfig(
    model=model_preset("tiny"),
    sampling=TupleConfig(negatives=2, positive_m=16.0),
    optimizer=OptimizerConfig(learning_rate=1e-3),
    steps=4,
    tuples=2,
    max_points=512,
    log_every=1,
    score_every=2,
)
