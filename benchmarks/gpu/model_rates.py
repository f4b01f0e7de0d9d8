"""How fast a model trains and describes on this device, what share of its peak that is, and the memory it takes."""

import dataclasses
from collections.abc import Callable

import jax
import numpy as np

from benchmarks.gpu.kept_rows import Row
from benchmarks.speed.flops import count_flops
from benchmarks.speed.inputs import random_batch, random_images
from benchmarks.speed.ratio import SPREAD, Job
from benchmarks.speed.throughput import StepJob, matrix_size, product_job, rates_in_turn, step_flops
from sglpr_jax.files import in_short
from sglpr_jax.models.sglpr import describe, init
from sglpr_jax.training.config import TrainConfig

NOMINAL_TYPE = "bfloat16"
"""The type that nominal peaks are given for here."""


@dataclasses.dataclass(frozen=True)
class Timing:
    """How often everything is timed, and against what."""

    repeats: int
    calls: int
    """Steps, or calls of `describe`, in one timing."""
    size: int | None
    """Rows and columns of the matrices whose product is the measured peak. None: large ones for the device."""
    products: int
    """Of them in one timing."""
    peak_tflops: float
    """The nominal peak of products in bfloat16, 10^12 operations a second."""


@dataclasses.dataclass(frozen=True)
class Work:
    """A job, and what is known of one of its calls."""

    job: Job
    flops: int
    images: int
    program: Callable[[], jax.stages.Compiled]
    """The compiled program; after the job has run nothing is compiled for it."""


def step_work(model: TrainConfig, calls: int) -> Work:
    """Training steps on a random batch that is on the device."""
    batch = jax.device_put(random_batch(model, model.max_points))
    job = StepJob(model, batch, calls)
    return Work(job, step_flops(model, batch), model.images, job.program)


def describe_work(model: TrainConfig, batch: int, calls: int) -> Work:
    """Descriptors of so many random images that are on the device; each call waits for its own."""
    params = jax.jit(init, static_argnames="config")(jax.random.key(0), config=model.model)
    images = jax.device_put(random_images(batch, model.model.grid, image="points")[0])
    described = jax.jit(describe)

    def job() -> None:
        for _ in range(calls):
            jax.block_until_ready(described(params, images))

    flops = count_flops(described.trace(params, images).jaxpr)
    return Work(job, flops, batch, lambda: described.lower(params, images).compile())


def measured(make: Callable[[], Work], compute: str, timing: Timing) -> Row:
    """Time work against matrix products in turn. Where the device refuses it, for want of memory say, why."""
    peak_before = peak_bytes()
    try:
        work, size = make(), timing.size or matrix_size()
        ours = work.job, timing.calls * work.flops
        product = product_job(compute, size, timing.products), timing.products * 2.0 * size**3
        rates, peaks = rates_in_turn(ours, product, repeats=timing.repeats)
        needed = program_bytes(work.program())
    except (jax.errors.JaxRuntimeError, FloatingPointError) as error:
        return {"error": in_short(error)}
    peak_after = peak_bytes()
    memory = {"program_bytes": needed, "peak_bytes": None if peak_after == peak_before else peak_after}
    nominal = timing.peak_tflops if compute == NOMINAL_TYPE else None
    return {**_shares(work, rates, peaks, nominal), **memory}


def _shares(work: Work, rates: np.ndarray, peaks: np.ndarray, nominal_tflops: float | None) -> Row:
    """Seconds, rates and shares: medians of what was measured in turn."""
    rate = float(np.median(rates))
    low, middle, high = map(float, np.quantile(rates / peaks, (SPREAD[0], 0.5, SPREAD[1])))
    return {
        "seconds": work.flops / rate,
        "images_per_second": work.images * rate / work.flops,
        "flop": work.flops,
        "flop_per_second": rate,
        "peak_flop_per_second": float(np.median(peaks)),
        "share_of_peak": middle,
        "share_of_peak_spread": (low, high),
        "nominal_tflops": nominal_tflops,
        "share_of_nominal": None if nominal_tflops is None else rate / (nominal_tflops * 1e12),
    }


def peak_bytes() -> int | None:
    """The most of the device's memory that this process has used so far; None where the device does not tell."""
    return (jax.devices()[0].memory_stats() or {}).get("peak_bytes_in_use")


def program_bytes(program: jax.stages.Compiled) -> int | None:
    """What a compiled program needs: inputs, outputs and what lies between; None where the compiler does not tell."""
    needs = program.memory_analysis()
    if needs is None:
        return None
    buffers = needs.argument_size_in_bytes + needs.output_size_in_bytes + needs.temp_size_in_bytes
    return buffers - needs.alias_size_in_bytes
