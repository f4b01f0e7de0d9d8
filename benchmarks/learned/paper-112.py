"""The paper's network for the ready-made images, with the training of `sglpr` in steps of half its size.

The paper's own training (the preset `paper-112`) takes 200,000 steps of one tuple, with a fortieth of this learning
rate. A CPU core does some hundred steps in an hour. Here the other places of a step are the negatives.

    python -m benchmarks learned preset --preset benchmarks/learned/paper-112.py --seconds 9000 \\
        --upright-images 6000 --learning-rate 4e-4
"""

import dataclasses

from sglpr_jax.models.config import model_preset
from sglpr_jax.training.config import OptimizerConfig
from sglpr_jax.training.presets import load_preset

CONFIG = dataclasses.replace(
    load_preset("sglpr"),
    model=model_preset("paper-112"),
    optimizer=OptimizerConfig(learning_rate=4e-4, warmup_steps=60, decay_rate=0.5, decay_steps=300, clip_norm=1.0),
    tuples=10,
    chunk=4,
)
