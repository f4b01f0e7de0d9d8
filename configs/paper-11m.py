"""The preset `paper` with the window of the printed "projection radius 11.2 m": cells of 0.1 m.

Reproduces table 1 if this radius is meant literally. The paper's own equation 1 indicates 0.2 m
(docs/decisions/paper.md).

Expect: as for `paper`; not measured here. It requires a GPU.

Command: bin/train --seq 08 --data KITTI --preset paper-11m
"""

import dataclasses

from sglpr_jax.models.presets import model_preset
from sglpr_jax.training.presets import load_preset

CONFIG = dataclasses.replace(load_preset("paper"), model=model_preset("paper-11m"))
