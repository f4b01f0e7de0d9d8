"""Trial: the descriptors of a teacher instead of the triplet loss."""

import dataclasses

import sglpr_jax

CONFIG = sglpr_jax.preset("sglpr")
CONFIG = dataclasses.replace(CONFIG, loss=dataclasses.replace(CONFIG.loss, teacher="sglpr"))
