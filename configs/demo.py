"""Training of bin/demo: the shipped weights `sglpr` are trained on for some minutes.

Reproduces no result of the paper. It shows that everything works, on two simulated recordings with labels.

Expect: 120 steps take a minute and a half on two CPU cores. On the simulated recording 00, the top-1 F1max is .99, with
and without rotation of every scan. The shipped weights have 1.00 and 1.00, untrained weights .78 and .79.

Command: bin/demo
"""

import dataclasses

from sglpr_jax.training.config import OptimizerConfig
from sglpr_jax.training.presets import load_preset

_SGLPR = load_preset("sglpr")

CONFIG = dataclasses.replace(
    _SGLPR,
    optimizer=OptimizerConfig(learning_rate=1e-4, warmup_steps=10, decay_rate=0.5, decay_steps=40, clip_norm=1.0),
    steps=120,
    score_every=60,
)
