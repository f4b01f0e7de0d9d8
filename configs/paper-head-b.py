"""The paper's model with its place head three times cheaper (candidate B: 4x4/4, 3x3/2, 3x3/2 convolutions).

Everything else is configs/paper.py. Expect numbers near the paper's table 1 on KITTI; not yet run at full length here.

Command: bin/train --seq 08 --data KITTI --preset paper-head-b
"""

import dataclasses

from sglpr_jax.cli.presets import load_preset
from sglpr_jax.models.presets import model_preset

CONFIG = dataclasses.replace(load_preset("paper"), model=model_preset("paper-head-b"))
