"""The paper's model with the window of the printed "projection radius 11.2 m" (cells of 0.1 m).

Everything else is configs/paper.py. Expect numbers near the paper's table 1 on KITTI; not yet run at full length here.

Command: bin/train --seq 08 --data KITTI --preset paper-11m
"""

import dataclasses

from sglpr_jax.cli.presets import load_preset
from sglpr_jax.models.presets import model_preset

CONFIG = dataclasses.replace(load_preset("paper"), model=model_preset("paper-11m"))
