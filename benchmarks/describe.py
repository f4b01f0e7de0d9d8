"""Describing images: ours, jitted, against PyTorch's eager modules of the same shape and weights."""

from typing import Literal

import jax
import numpy as np
import tyro
from inputs import comparable_model, random_params, random_scans
from ratio import Contender, Job, alternate, check_equal, report, report_resources, require_torch, warn_if_busy

from sglpr_jax.bev import rasterize
from sglpr_jax.models.input_image import prepare
from sglpr_jax.models.params import Params
from sglpr_jax.models.sglpr import describe


def main(
    *,
    preset: Literal["small", "paper"] = "small",
    batch: int = 1,
    repeats: int = 20,
    chunk: tuple[int, ...] = (0,),
    torch_chunk: int = 0,
    threads: int = 2,
) -> None:
    """Time descriptors on the CPU against PyTorch.

    Args:
        preset: the model; a polar one is timed without its resampling.
        batch: images in one call.
        repeats: how often both are timed against each other.
        chunk: images that ours takes at a time inside one jit (0: all at once); several are compared in turn.
        torch_chunk: the same for PyTorch's loop.
        threads: threads that each program may use.
    """
    require_torch()
    warn_if_busy(threads)
    params = random_params(comparable_model(preset))
    grid = params.config.grid
    bev = np.asarray(rasterize(random_scans(batch, 120_000, grid=grid)[0], grid=grid))

    other = Contender(
        "PyTorch", torch_job, params, np.asarray(prepare(bev, params.config)), torch_chunk, threads=threads
    )
    ours = [Contender(f"JAX, chunk {size}", jax_job, params, bev, size, threads=threads) for size in chunk]
    expected = other.run()[0]
    for contender in ours:
        check_equal(f"descriptors, {contender.name}", contender.run()[0], expected, tolerance=1e-4)
    for contender in (other, *ours):
        contender.forget_peak()
    seconds = alternate([other, *ours], repeats=repeats)
    rows = [(contender.name, seconds[:, i], seconds[:, 0]) for i, contender in enumerate(ours, start=1)]
    report(f"describe, {preset}, {batch} image(s)", rows, other="PyTorch", packages=("jax", "torch"), threads=threads)
    report_resources([other, *ours])


def jax_job(params: Params, bev: np.ndarray, chunk: int) -> Job:
    """Our `describe`, over chunks of the images inside one jit."""
    size = chunk or len(bev)

    @jax.jit
    def in_chunks(params: Params, bev: jax.Array) -> jax.Array:
        return jax.lax.map(lambda part: describe(params, part), bev.reshape(-1, size, *bev.shape[1:]))

    arguments = jax.device_put((params, bev))
    return lambda: np.asarray(in_chunks(*arguments)).reshape(len(bev), -1)


def torch_job(params: Params, images: np.ndarray, chunk: int) -> Job:
    """PyTorch's, on images whose counts are rescaled already; only this process imports PyTorch."""
    import torch_reference

    return torch_reference.describe_job(params, images, chunk)


if __name__ == "__main__":
    tyro.cli(main)
