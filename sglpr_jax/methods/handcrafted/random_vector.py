"""Random vectors, the lower baseline: they contain no information about the place."""

import zlib

import numpy as np
from jaxtyping import Float32, Num

from sglpr_jax.methods.method import HandcraftedMethod
from sglpr_jax.methods.unit_length import unit_length

NUMBERS = 256


def random_vector(images: Num[np.ndarray, "n h w"]) -> Float32[np.ndarray, "n 256"]:
    """Return one random direction per image. The image is the seed, so equal images have equal descriptors."""
    seeds = [zlib.crc32(np.ascontiguousarray(image).tobytes()) for image in images]
    return unit_length(np.stack([np.random.default_rng(seed).normal(size=NUMBERS) for seed in seeds]))


RANDOM = HandcraftedMethod(
    "random",
    "this project: what knows nothing of the place",
    "images",
    random_vector,
)
