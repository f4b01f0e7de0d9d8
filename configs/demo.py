"""What bin/demo trains: the shipped weights `sglpr`, a little longer, in minutes.

Reproduces nothing of the paper; it shows that everything works, on two simulated recordings with labels.

Expect: 120 steps in a minute and a half on two CPU cores; on the simulated recording 00 a top-1 F1max of .99, and the
same with every scan rotated (the weights as they ship: 1.00 and 1.00; untrained: .78 and .79).

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
