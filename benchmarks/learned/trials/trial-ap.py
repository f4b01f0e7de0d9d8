"""Trial: truncated smooth AP instead of the triplet loss with own negatives."""

import dataclasses

import sglpr_jax

CONFIG = sglpr_jax.preset("sglpr")
CONFIG = dataclasses.replace(CONFIG, loss=dataclasses.replace(CONFIG.loss, ranking="ap"))
