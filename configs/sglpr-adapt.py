"""Adaptation of weights from the simulator to real images without labels: `sglpr`, trained on for some minutes.

Reproduces no result of the paper. It is `rings-adapt` with SG-LPR's network, a lower learning rate, and half of the
tuples simulated. The model learns places on real images, and places and semantics on simulated images
(docs/guides/training.md).

Expect: on the KITTI BEV images, trained on 00 and 02, whitened on them and tested on 06: top-1 F1max .994, pairs F1max
.937, Recall@1 1.000; rotated .996, .922 and 1.000 (one seed). Without this training: .991, .924 and 1.000. The 240
steps take three minutes on one CPU core, or seven on a busy one.

Command: bin/train --seq 06 --data KITTI_BEV --also SIMULATED --weights sglpr --preset sglpr-adapt
"""

import dataclasses

from sglpr_jax.models.presets import model_preset
from sglpr_jax.training.presets import load_preset

_RINGS = load_preset("rings-adapt")
CONFIG = dataclasses.replace(
    _RINGS,
    model=model_preset("sglpr"),
    optimizer=dataclasses.replace(_RINGS.optimizer, learning_rate=3e-4),
    also_tuples=10,
)
