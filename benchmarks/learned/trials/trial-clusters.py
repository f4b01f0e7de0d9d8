"""Trial: 32 clusters instead of 64."""

import dataclasses

import sglpr_jax

CONFIG = sglpr_jax.preset("sglpr")
HEAD = dataclasses.replace(CONFIG.model.head, clusters=32)
CONFIG = dataclasses.replace(CONFIG, model=dataclasses.replace(CONFIG.model, head=HEAD))
