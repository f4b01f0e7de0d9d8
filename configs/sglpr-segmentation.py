"""Training of the semantic map of `sglpr` after the places: all images are segmented, and descriptors do not change.

Reproduces no result of the paper, which learns both at once, as `sglpr` does first. Whitening is kept, so the final
weights give the same descriptors as the initial ones (docs/guides/semantics.md).

Expect: from the earlier weights `sglpr`, the mean IoU rose from .247 to .309 on a simulated recording of an unseen
town, and from .138 to .169 on 36 real labelled scans (sglpr_jax/weights/sglpr/README.md). One step takes 1.6 s on a CPU
core.

Command: bin/train --seq 08 --data TOWNS --weights sglpr --preset sglpr-segmentation
"""

import dataclasses

from sglpr_jax.training.config import OcclusionConfig, OptimizerConfig
from sglpr_jax.training.presets import load_preset

_SGLPR = load_preset("sglpr")
CONFIG = dataclasses.replace(
    _SGLPR,
    model=dataclasses.replace(_SGLPR.model, head=dataclasses.replace(_SGLPR.model.head, whiten=True)),
    loss=dataclasses.replace(_SGLPR.loss, segmentation_alone=True, segment_every=1),
    optimizer=OptimizerConfig(learning_rate=2e-3, warmup_steps=40, decay_rate=0.5, decay_steps=450, clip_norm=1.0),
    occlusion=OcclusionConfig(share=0.2),
    quarter_turns=1.0,
    steps=2400,
)
