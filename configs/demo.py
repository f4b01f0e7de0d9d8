"""What bin/demo trains: the preset `small` made smaller, in minutes.

Reproduces nothing of the paper; it shows that everything works, on two simulated recordings with labels.

Expect: 500 steps in about three minutes on two CPU cores; on the simulated recording 00 a top-1 F1max near .76, and
near .73 with every scan rotated (untrained weights: .72 and .14).

Command: bin/demo
"""

import dataclasses

from sglpr_jax.models.presets import model_preset
from sglpr_jax.training.config import OptimizerConfig
from sglpr_jax.training.presets import load_preset

_SMALL = load_preset("small")

CONFIG = dataclasses.replace(
    _SMALL,
    model=model_preset("demo"),
    # Two recordings are few: neighbouring places are the hard negatives.
    sampling=dataclasses.replace(_SMALL.sampling, cluster=4),
    loss=dataclasses.replace(_SMALL.loss, segment_every=4),
    optimizer=OptimizerConfig(learning_rate=1e-3, warmup_steps=20, decay_rate=0.5, decay_steps=100, clip_norm=1.0),
    steps=500,
    tuples=16,
    max_points=32768,
    score_every=250,
)
