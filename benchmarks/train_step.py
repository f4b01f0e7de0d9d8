"""One training step, ours against PyTorch's: a tuple of 12 labelled images, forward, backward, Adam."""

import dataclasses
from typing import Literal

import jax
import numpy as np
import tyro
from inputs import comparable_model, random_batch, random_params
from ratio import Contender, Job, alternate, check_equal, report, report_resources, require_torch, warn_if_busy

from sglpr_jax.data.sampling.batch import Batch, views
from sglpr_jax.models.input_image import prepare
from sglpr_jax.models.params import Params
from sglpr_jax.training.config import LossConfig, TrainConfig
from sglpr_jax.training.state import new_state
from sglpr_jax.training.step import train_step

PAPER_LOSS = LossConfig(margin=0.5, squared=True, reduction="max", temperature=0.0)
CHECKED_STEPS = 2


def main(
    *,
    preset: Literal["small", "paper"] = "small",
    repeats: int = 10,
    chunk: tuple[int, ...] = (0,),
    points: int = 0,
    threads: int = 2,
) -> None:
    """Time training steps on the CPU against PyTorch.

    Both get the same images and start from the same weights; the losses and gradients of their first two steps must
    agree.

    Args:
        preset: the model; a polar one is timed without its resampling, and stochastic depth is off.
        repeats: how often both are timed against each other.
        chunk: images that ours takes through the network at a time (0: all 12); several are compared in turn.
        points: of clouds that ours rasterises within its step, while PyTorch still gets the images; 0: none.
        threads: threads that each program may use.
    """
    require_torch()
    warn_if_busy(threads)
    config = TrainConfig(model=comparable_model(preset), loss=PAPER_LOSS, rotate=False)
    params = random_params(config.model)
    batch = random_batch(config, points)
    images, maps = views(batch, None, config.model.grid)
    images = prepare(images, config.model)

    other = Contender("PyTorch", torch_job, params, *map(np.asarray, (images, maps)), config, threads=threads)
    ours = [
        Contender(
            f"JAX, chunk {size}", jax_job, params, batch, dataclasses.replace(config, chunk=size), threads=threads
        )
        for size in chunk
    ]
    expected = first_steps(other)
    for contender in ours:
        check_equal(f"losses and gradient norms, {contender.name}", first_steps(contender), expected, tolerance=1e-3)
    for contender in (other, *ours):
        contender.forget_peak()
    seconds = alternate([other, *ours], repeats=repeats)
    rows = [(contender.name, seconds[:, i], seconds[:, 0]) for i, contender in enumerate(ours, start=1)]
    title = f"training step, {preset}, {config.images} images with labels"
    report(title, rows, other="PyTorch", packages=("jax", "torch", "optax"), threads=threads)
    report_resources([other, *ours])


def first_steps(contender: Contender) -> np.ndarray:
    """Loss and gradient norm of the first steps."""
    return np.stack([contender.run()[0] for _ in range(CHECKED_STEPS)])


def jax_job(params: Params, batch: Batch, config: TrainConfig) -> Job:
    """Our `train_step`, from step to step."""
    state, batch = new_state(config, params=jax.device_put(params)), jax.device_put(batch)

    def job() -> np.ndarray:
        nonlocal state
        state, metrics = jax.block_until_ready(train_step(state, batch, config=config))
        return np.array([metrics["loss"], metrics["gradient_norm"]])

    return job


def torch_job(params: Params, images: np.ndarray, maps: np.ndarray, config: TrainConfig) -> Job:
    """PyTorch's step; only this process imports PyTorch."""
    import torch_reference

    return torch_reference.train_job(params, images, maps, config)


if __name__ == "__main__":
    tyro.cli(main)
