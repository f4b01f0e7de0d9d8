"""Trial: random places instead of mined ones."""

import dataclasses

import sglpr_jax

CONFIG = sglpr_jax.preset("sglpr")
CONFIG = dataclasses.replace(CONFIG, sampling=dataclasses.replace(CONFIG.sampling, mining="none"))
