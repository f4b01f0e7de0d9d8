"""Descriptors without training, to compare with: each a pure function from BEV images to unit-length descriptors."""

from sglpr_jax.evaluation.baselines.polar_fft import polar_fft as polar_fft
from sglpr_jax.evaluation.baselines.thumbnail import thumbnail as thumbnail
