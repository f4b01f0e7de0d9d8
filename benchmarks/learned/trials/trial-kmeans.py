"""Trial: NetVLAD that begins with centres by k-means and a projection by PCA."""

import dataclasses

import sglpr_jax

CONFIG = sglpr_jax.preset("sglpr")
CONFIG = dataclasses.replace(CONFIG, netvlad_images=1000)
