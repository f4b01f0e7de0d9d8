"""The paper's network for the ready-made images of KITTI: cells of 0.4 m instead of 0.2 m, patches of 2 x 2 cells.

Reproduces every stage of the preset `paper`, with the same tokens and the same window of 22.4 m to each side. The
images are those that BEVPlace publishes and that `bin/simulate --images` writes. So both presets can be compared on one
dataset.

Expect: like `paper`, it requires a GPU. After an hour of training on a CPU core without rotations it has .684 / .492 /
.811 on real 06 (top-1 F1max, pairs F1max, Recall@1). With rotations from the first step it has less than before
training (docs/results.md).

Command: bin/train --seq 08 --data IMAGES --preset paper-112
"""

import dataclasses

from sglpr_jax.models.config import model_preset
from sglpr_jax.training.presets import load_preset

CONFIG = dataclasses.replace(load_preset("paper"), model=model_preset("paper-112"))
