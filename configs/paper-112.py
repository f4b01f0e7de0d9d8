"""The network of the paper on the ready-made images of KITTI: cells of 0.4 m in place of 0.2 m, patches of 2 x 2 cells.

Reproduces every stage of the preset `paper` (same tokens, same window of 22.4 m to each side) for images that BEVPlace
publishes and `bin/simulate --images` writes, so that both can be compared on one dataset.

Expect: as `paper` it wants a GPU. After 613 steps of 20 images, 80 minutes of a CPU core, it was still behind what it
is before training (docs/results.md).

Command: bin/train --seq 08 --data IMAGES --preset paper-112
"""

import dataclasses

from sglpr_jax.models.presets import model_preset
from sglpr_jax.training.presets import load_preset

CONFIG = dataclasses.replace(load_preset("paper"), model=model_preset("paper-112"))
