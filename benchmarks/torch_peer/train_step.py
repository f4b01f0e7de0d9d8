"""One training step, ours against PyTorch's: a tuple of 12 images, forward, backward, Adam."""

import dataclasses

import jax
import numpy as np
import tyro

from benchmarks.speed.inputs import comparable_model, random_batch, random_params
from benchmarks.speed.ratio import Contender, Job
from benchmarks.torch_peer.beside_torch import Preset, compare, prepare_to_compare, torch_contenders
from sglpr_jax.data.sampling.batch import Batch, views
from sglpr_jax.labels import UNLABELLED
from sglpr_jax.models.input_image import field_of_view
from sglpr_jax.models.params import Params
from sglpr_jax.training.config import LossConfig, TrainConfig
from sglpr_jax.training.state import new_state
from sglpr_jax.training.step import train_step

PAPER_LOSS = LossConfig(margin=0.5, squared=True, reduction="max", temperature=0.0)
"""For every preset: one tuple has no use for the losses that read other tuples."""
CHECKED_STEPS = 2


def main(
    *,
    preset: Preset = "sglpr",
    labels: bool = True,
    repeats: int = 10,
    chunk: tuple[int, ...] = (0,),
    points: int = 0,
    compiled: bool = False,
    threads: int = 2,
) -> None:
    """Time training steps on the CPU against PyTorch.

    Both get the same images and start from the same weights; the losses and gradients of their first two steps must
    agree.

    Args:
        preset: the model, without stochastic depth.
        labels: whether all images have them; without them there is no segmentation head, and the loss is the triplets'.
        repeats: how often both are timed against each other.
        chunk: images that ours takes through the network at a time (0: all 12); several are compared in turn.
        points: of clouds that ours rasterises within its step, while PyTorch still gets the images; 0: none.
        compiled: time PyTorch through `torch.compile` too.
        threads: threads that each program may use.
    """
    prepare_to_compare(threads, compiled=compiled)
    config = TrainConfig(model=comparable_model(preset, labels=labels), loss=PAPER_LOSS, rotate=False)
    params, batch = random_params(config.model), random_batch(config, points, labels=labels)
    theirs = torch_contenders(
        torch_job, params, *seen_images(batch, config), config, compiled=compiled, threads=threads
    )
    configs = {f"JAX, chunk {size}": dataclasses.replace(config, chunk=size) for size in chunk}
    compare(
        f"training step, {preset}, {config.images} images with{'' if labels else 'out'} labels",
        theirs,
        [Contender(name, jax_job, params, batch, one, threads=threads) for name, one in configs.items()],
        first=first_steps,
        what="losses and gradient norms",
        tolerance=1e-3,
        repeats=repeats,
        threads=threads,
    )


def seen_images(batch: Batch, config: TrainConfig) -> tuple[np.ndarray, np.ndarray | None]:
    """The images of counts of a step and, where there are labels, their classes, of which none is out of view."""
    images, maps = views(batch, None, config.model.grid)
    if maps is None:
        return np.asarray(images), None
    return np.asarray(images), np.where(field_of_view(config.model), maps, UNLABELLED)


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


def torch_job(params: Params, images: np.ndarray, maps: np.ndarray | None, config: TrainConfig, compiled: bool) -> Job:
    """PyTorch's step; only this process imports PyTorch."""
    from benchmarks.torch_peer import torch_reference

    return torch_reference.train_job(params, images, maps, config, compiled)


if __name__ == "__main__":
    tyro.cli(main)
