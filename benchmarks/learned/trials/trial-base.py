"""Trial: the preset sglpr."""

import dataclasses

import sglpr_jax

CONFIG = sglpr_jax.preset("sglpr")
