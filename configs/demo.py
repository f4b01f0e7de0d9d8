"""What bin/demo trains: the small model made smaller, on two simulated drives with labels, in minutes.

Expect: see docs/results.md.
Command: bin/demo
"""

import dataclasses

from sglpr_jax.cli.presets import load_preset
from sglpr_jax.models.presets import model_preset
from sglpr_jax.train.config import OptimizerConfig

_SMALL = load_preset("small")

CONFIG = dataclasses.replace(
    _SMALL,
    model=model_preset("demo"),
    sampling=dataclasses.replace(_SMALL.sampling, cluster=4),  # two drives are few: neighbours are the hard negatives
    loss=dataclasses.replace(_SMALL.loss, segment_every=4),
    optimizer=OptimizerConfig(learning_rate=1e-3, warmup_steps=20, decay_rate=0.5, decay_steps=100, clip_norm=1.0),
    steps=500,
    tuples=16,
    max_points=32768,
    score_every=250,
)
