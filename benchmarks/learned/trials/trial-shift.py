"""Trial: every image is shifted by up to 2 m along each axis."""

import dataclasses

import sglpr_jax

CONFIG = dataclasses.replace(sglpr_jax.preset("sglpr"), shift_cells=5)
