"""Trial: nine of ten tuples have a positive from another visit, instead of every second."""

import dataclasses

import sglpr_jax

CONFIG = sglpr_jax.preset("sglpr")
CONFIG = dataclasses.replace(CONFIG, sampling=dataclasses.replace(CONFIG.sampling, revisit_fraction=0.9))
