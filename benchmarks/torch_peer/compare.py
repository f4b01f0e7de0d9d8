"""Time beside PyTorch: descriptors and training steps of modules of the same shape and weights."""

import importlib.util
import os
import shutil
from collections.abc import Callable, Sequence
from typing import Any, Literal

import jax
import numpy as np

from benchmarks.speed.inputs import comparable_model, random_batch, random_images, random_params
from benchmarks.timing import Contender, Job, check_equal, in_turn, report, warn_if_busy
from sglpr_jax.extras import install_command
from sglpr_jax.labels import UNLABELLED
from sglpr_jax.models.input_image import field_of_view
from sglpr_jax.models.sglpr import describe as describe_images
from sglpr_jax.models.weights import Params
from sglpr_jax.training.batches import Batch, views
from sglpr_jax.training.config import LossConfig, TrainConfig
from sglpr_jax.training.image_network import ImageNetwork
from sglpr_jax.training.step import train_step

Preset = Literal["sglpr-small", "sglpr"]
"""The models of which there is a PyTorch counterpart."""
PAPER_LOSS = LossConfig(margin=0.5, squared=True, temperature=0.0)
"""For every preset: one tuple has no use for the losses that read other tuples."""
CHECKED_STEPS = 2


def describe(
    *,
    preset: Preset = "sglpr",
    batch: int = 1,
    repeats: int = 20,
    calls: int = 1,
    compiled: bool = False,
    threads: int = 2,
) -> None:
    """Time descriptors on the CPU against PyTorch: the whole way from images of counts.

    Args:
        preset: the model.
        batch: images in one call.
        repeats: how often both are timed against each other.
        calls: of one run; the first of a run finds the caches as the other program left them.
        compiled: time PyTorch through `torch.compile` too.
        threads: threads that each program may use.
    """
    _prepare(threads, compiled=compiled)
    params = random_params(comparable_model(preset))
    images, _ = random_images(batch, params.config.grid, image="points")
    theirs = _torch_contenders(_torch_describes, params, images, calls, compiled=compiled, threads=threads)
    _compare(
        f"describe, {preset}, {batch} image(s)",
        theirs,
        Contender("JAX", _jax_describes, params, images, calls, threads=threads),
        first=lambda contender: contender.run()[0],
        what="descriptors",
        tolerance=1e-4,
        repeats=repeats,
        threads=threads,
        calls=calls,
    )


def _jax_describes(params: Params, images: np.ndarray, calls: int) -> Job:
    """Our `describe`."""
    described, arguments = jax.jit(describe_images), jax.device_put((params, images))
    return _again(lambda: np.asarray(described(*arguments)), calls)


def _torch_describes(params: Params, images: np.ndarray, calls: int, compiled: bool) -> Job:
    """PyTorch's; only this process imports PyTorch."""
    from benchmarks.torch_peer import torch_model

    return _again(torch_model.describe_job(params, images, compiled), calls)


def _again(job: Job, calls: int) -> Job:
    """The job so many times; the last value."""
    return lambda: [job() for _ in range(calls)][-1]


def step(
    *,
    preset: Preset = "sglpr",
    labels: bool = True,
    repeats: int = 10,
    compiled: bool = False,
    threads: int = 2,
) -> None:
    """Time training steps on the CPU against PyTorch: a tuple of 12 images, forward, backward, Adam.

    Both get the same images and start from the same weights; the losses and gradients of their first two steps must
    agree.

    Args:
        preset: the model, without stochastic depth.
        labels: whether all images have them; without them there is no segmentation head, and the loss is the triplets'.
        repeats: how often both are timed against each other.
        compiled: time PyTorch through `torch.compile` too.
        threads: threads that each program may use.
    """
    _prepare(threads, compiled=compiled)
    config = TrainConfig(model=comparable_model(preset, labels=labels), loss=PAPER_LOSS, rotate=False)
    params, batch = random_params(config.model), random_batch(config, 0, labels=labels)
    seen = seen_images(batch, config)
    theirs = _torch_contenders(_torch_trains, params, *seen, config, compiled=compiled, threads=threads)
    _compare(
        f"training step, {preset}, {config.images} images with{'' if labels else 'out'} labels",
        theirs,
        Contender("JAX", _jax_trains, params, batch, config, threads=threads),
        first=lambda contender: np.stack([contender.run()[0] for _ in range(CHECKED_STEPS)]),
        what="losses and gradient norms",
        tolerance=1e-3,
        repeats=repeats,
        threads=threads,
    )


def seen_images(batch: Batch, config: TrainConfig) -> tuple[np.ndarray, np.ndarray | None]:
    """The images of counts of a step and, if there are labels, their classes, of which none is out of view."""
    images, maps = views(batch, None, config.model.grid)
    if maps is None:
        return np.asarray(images), None
    return np.asarray(images), np.where(field_of_view(config.model), maps, UNLABELLED)


def _jax_trains(params: Params, batch: Batch, config: TrainConfig) -> Job:
    """Our `train_step`, from step to step."""
    network = ImageNetwork(config)
    state, batch = network.new_state(jax.device_put(params)), jax.device_put(batch)

    def job() -> np.ndarray:
        nonlocal state
        state, metrics = jax.block_until_ready(train_step(state, batch, network=network))
        return np.array([metrics["loss"], metrics["gradient_norm"]])

    return job


def _torch_trains(
    params: Params, images: np.ndarray, maps: np.ndarray | None, config: TrainConfig, compiled: bool
) -> Job:
    """PyTorch's step; only this process imports PyTorch."""
    from benchmarks.torch_peer import torch_model

    return torch_model.train_job(params, images, maps, config, compiled)


def _prepare(threads: int, *, compiled: bool) -> None:
    """Raises SystemExit if PyTorch or, to compile, a C++ compiler is missing; warns on a busy machine."""
    if importlib.util.find_spec("torch") is None:
        raise SystemExit(f"this benchmark compares with PyTorch, which is not installed: {install_command('torch')}")
    compiler = os.environ.get("CXX", "g++")  # as torch.compile looks for it
    if compiled and shutil.which(compiler) is None:
        raise SystemExit(f"--compiled: torch.compile needs a C++ compiler, but there is no {compiler}")
    warn_if_busy(threads)


def _torch_contenders(make_job: Callable[..., Job], *arguments: Any, compiled: bool, threads: int) -> list[Contender]:
    """PyTorch eager and, if asked for, compiled: the last argument of the job."""
    names = {"PyTorch": False} | ({"PyTorch compiled": True} if compiled else {})
    return [Contender(name, make_job, *arguments, through, threads=threads) for name, through in names.items()]


def _compare(
    title: str,
    theirs: Sequence[Contender],
    ours: Contender,
    *,
    first: Callable[[Contender], np.ndarray],
    what: str,
    tolerance: float,
    repeats: int,
    threads: int,
    calls: int = 1,
) -> None:
    """Check that all give the same `first` results, time runs of so many calls in turn, and print the tables."""
    expected = first(theirs[0])
    for contender in (*theirs[1:], ours):
        check_equal(f"{what}, {contender.name}", first(contender), expected, tolerance=tolerance)
    everyone = [*theirs, ours]
    for contender in everyone:
        contender.forget_peak()
    seconds = dict(zip(everyone, (in_turn(everyone, repeats=repeats) / calls).T, strict=True))
    for other in theirs:
        both = ((one.name, seconds[one]) for one in (ours, other))
        report(title, *both, packages=("jax", "torch", "optax"), threads=threads)
    usages = {contender.name: contender.usage() for contender in everyone}
    used = "; ".join(
        f"{name} {seconds / calls:.3g} s, {megabytes:.0f} MB" for name, (seconds, megabytes) in usages.items()
    )
    print(f"Processor time of a {'call' if calls > 1 else 'run'}, and peak of resident memory: {used}")
