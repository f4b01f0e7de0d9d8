"""The network of the paper on the ready-made images of KITTI: cells of 0.4 m in place of 0.2 m, patches of 2 x 2 cells.

Reproduces every stage of the preset `paper` (same tokens, same window of 22.4 m to each side) for images that BEVPlace
publishes and `bin/simulate --images` writes, so that both can be compared on one dataset.

Expect: as `paper` it wants a GPU. Trained for an hour of a CPU core without rotations it has .684 / .492 / .811 on real
06 (top-1 F1max, pairs F1max, Recall@1); with rotations from the first step less than before training (docs/results.md).

Command: bin/train --seq 08 --data IMAGES --preset paper-112
"""

import dataclasses

from sglpr_jax.models.presets import model_preset
from sglpr_jax.training.presets import load_preset

CONFIG = dataclasses.replace(load_preset("paper"), model=model_preset("paper-112"))
