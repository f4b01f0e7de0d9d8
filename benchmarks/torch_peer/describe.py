"""Describing images: ours, jitted, against PyTorch's modules of the same shape and weights."""

import jax
import numpy as np
import tyro

from benchmarks.speed.inputs import comparable_model, random_images, random_params
from benchmarks.speed.ratio import Contender, Job
from benchmarks.torch_peer.beside_torch import Preset, compare, prepare_to_compare, torch_contenders
from sglpr_jax.models.params import Params
from sglpr_jax.models.sglpr import describe


def main(
    *,
    preset: Preset = "sglpr",
    batch: int = 1,
    repeats: int = 20,
    calls: int = 1,
    chunk: tuple[int, ...] = (0,),
    torch_chunk: int = 0,
    compiled: bool = False,
    threads: int = 2,
) -> None:
    """Time descriptors on the CPU against PyTorch: the whole way from images of counts.

    Args:
        preset: the model.
        batch: images in one call.
        repeats: how often both are timed against each other.
        calls: of one run; the first of a run finds the caches as the other program left them.
        chunk: images that ours takes at a time inside one jit (0: all at once); several are compared in turn.
        torch_chunk: the same for PyTorch's loop.
        compiled: time PyTorch through `torch.compile` too.
        threads: threads that each program may use.
    """
    prepare_to_compare(threads, compiled=compiled)
    params = random_params(comparable_model(preset))
    images, _ = random_images(batch, params.config.grid, image="points")
    theirs = torch_contenders(torch_job, params, images, torch_chunk, calls, compiled=compiled, threads=threads)
    ours = [Contender(f"JAX, chunk {size}", jax_job, params, images, size, calls, threads=threads) for size in chunk]
    compare(
        f"describe, {preset}, {batch} image(s)",
        theirs,
        ours,
        first=lambda contender: contender.run()[0],
        what="descriptors",
        tolerance=1e-4,
        repeats=repeats,
        threads=threads,
        calls=calls,
    )


def jax_job(params: Params, images: np.ndarray, chunk: int, calls: int) -> Job:
    """Our `describe`, over chunks of the images inside one jit."""
    size = chunk or len(images)

    @jax.jit
    def in_chunks(params: Params, images: jax.Array) -> jax.Array:
        return jax.lax.map(lambda part: describe(params, part), images.reshape(-1, size, *images.shape[1:]))

    arguments = jax.device_put((params, images))

    def once() -> np.ndarray:
        return np.asarray(in_chunks(*arguments)).reshape(len(images), -1)

    return again(once, calls)


def torch_job(params: Params, images: np.ndarray, chunk: int, calls: int, compiled: bool) -> Job:
    """PyTorch's; only this process imports PyTorch."""
    from benchmarks.torch_peer import torch_reference

    return again(torch_reference.describe_job(params, images, chunk, compiled), calls)


def again(job: Job, calls: int) -> Job:
    """The job so many times; the last value."""
    return lambda: [job() for _ in range(calls)][-1]


if __name__ == "__main__":
    tyro.cli(main)
