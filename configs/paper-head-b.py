"""The preset `paper` with a place head of a third of the cost: a 4 x 4 convolution of stride 4, then two of 3 x 3.

Reproduces table 1. The paper gives no sizes of the place head (docs/decisions/paper.md, place head).

Expect: as for `paper`; not measured here. It requires a GPU.

Command: bin/train --seq 08 --data KITTI --preset paper-head-b
"""

import dataclasses

from sglpr_jax.models.presets import model_preset
from sglpr_jax.training.presets import load_preset

CONFIG = dataclasses.replace(load_preset("paper"), model=model_preset("paper-head-b"))
