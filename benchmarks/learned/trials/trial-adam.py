"""Trial: Adam instead of Muon."""

import dataclasses

import sglpr_jax

CONFIG = sglpr_jax.preset("sglpr")
CONFIG = dataclasses.replace(CONFIG, optimizer=dataclasses.replace(CONFIG.optimizer, algorithm="adam"))
