"""Training steps and descriptors: rates, operations, and their share of the device's peak."""

import dataclasses
import math
import os
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr
from jax.interpreters.partial_eval import dce_jaxpr

from benchmarks.speed.inputs import random_batch, random_images
from benchmarks.table import Table
from benchmarks.timing import SPREAD, Job, about, clocked, in_turn, peak_mb
from sglpr_jax.files import in_short
from sglpr_jax.models.sglpr import describe, init
from sglpr_jax.training.batches import Batch
from sglpr_jax.training.config import TrainConfig
from sglpr_jax.training.image_network import ImageNetwork
from sglpr_jax.training.presets import load_preset
from sglpr_jax.training.step import train_step

NOMINAL_TYPE = "bfloat16"
"""Type of the nominal peak."""


def count_flops(program: ClosedJaxpr) -> int:
    """Operations of the matrix products and convolutions that the outputs of a traced program need.

    A product and its addition are two operations. Of a branch, the side with more operations counts. XLA's own analysis
    counts the body of a loop once. Raises ValueError for a product in a loop whose number of turns is unknown.
    """
    needed, _ = dce_jaxpr(program.jaxpr, [True] * len(program.jaxpr.outvars))
    return sum(map(_flops_of, needed.eqns))


def _flops_of(equation: Any) -> int:
    """Operations of an equation. Zeros between the inputs of a convolution (`lhs_dilation`) are no work; padding is."""
    name, parameters = equation.primitive.name, equation.params
    if name == "dot_general":
        (summed, _), _ = parameters["dimension_numbers"]
        left, out = equation.invars[0].aval.shape, equation.outvars[0].aval.shape
        return 2 * math.prod(out) * math.prod(left[axis] for axis in summed)
    if name == "conv_general_dilated":
        _, inputs, *spatial = parameters["dimension_numbers"].rhs_spec
        kernel, out = equation.invars[1].aval.shape, equation.outvars[0].aval.shape
        taps = math.prod(kernel[axis] for axis in spatial)
        return 2 * math.prod(out) * kernel[inputs] * taps // math.prod(parameters["lhs_dilation"])
    programs = [inner for value in parameters.values() for inner in (value if isinstance(value, tuple) else (value,))]
    programs = [inner.jaxpr if isinstance(inner, ClosedJaxpr) else inner for inner in programs]
    flops = [sum(map(_flops_of, inner.eqns)) for inner in programs if isinstance(inner, Jaxpr)]
    if name == "cond":
        return max(flops)
    if name == "while" and any(flops):
        raise ValueError("a matrix product in a loop whose number of turns is not known cannot be counted")
    return (parameters["length"] if name == "scan" else 1) * sum(flops)


def step_flops(config: TrainConfig, batch: Batch) -> int:
    """Operations of a step in one piece: a step in chunks goes forward twice, which is no work of the model's."""
    whole = ImageNetwork(dataclasses.replace(config, chunk=0))
    return count_flops(train_step.trace(jax.eval_shape(whole.new_state), batch, network=whole).jaxpr)


@dataclasses.dataclass(frozen=True)
class Timing:
    """How often everything is timed, and against what."""

    repeats: int
    calls: int
    """Steps, or calls of `describe`, in one timing."""
    size: int | None
    """Rows and columns of the matrices whose product is the measured peak. None: 2048 on a CPU, 8192 elsewhere."""
    products: int = 4
    """Matrix products in one timing."""
    peak_tflops: float | None = None
    """The nominal peak of products in bfloat16, 10^12 operations a second."""


@dataclasses.dataclass(frozen=True)
class Work:
    """A job, and what is known of one of its calls."""

    job: Job
    flops: int
    images: int
    program: Callable[[], jax.stages.Compiled]
    """The compiled program; after the job has run nothing is compiled for it."""


def step_work(config: TrainConfig, calls: int, *, labels: bool = True) -> Work:
    """Training steps, one after another, on a random batch that is on the device: all but reading.

    The job raises FloatingPointError if the loss is no longer finite.
    """
    batch, network = jax.device_put(random_batch(config, config.max_points, labels=labels)), ImageNetwork(config)
    state = network.new_state()

    def job() -> None:
        nonlocal state
        for _ in range(calls):
            state, metrics = train_step(state, batch, network=network)
        if not np.isfinite(metrics["loss"]):
            raise FloatingPointError(f"the loss is {metrics['loss']}: what was timed is no training")

    flops = step_flops(config, batch)
    return Work(job, flops, config.images, lambda: train_step.lower(state, batch, network=network).compile())


def describe_work(config: TrainConfig, batch: int, calls: int) -> Work:
    """Descriptors of this number of random images that are on the device; each call waits for its own."""
    params = jax.jit(init, static_argnames="config")(jax.random.key(0), config=config.model)
    images = jax.device_put(random_images(batch, config.model.grid, image="points")[0])
    described = jax.jit(describe)

    def job() -> None:
        for _ in range(calls):
            jax.block_until_ready(described(params, images))

    flops = count_flops(described.trace(params, images).jaxpr)
    return Work(job, flops, batch, lambda: described.lower(params, images).compile())


def product_job(type_: str, size: int, products: int) -> Job:
    """Products of two square matrices."""
    keys = jax.random.split(jax.random.key(0))
    a, b = (jax.random.normal(key, (size, size), jnp.dtype(type_)) for key in keys)
    multiply = jax.jit(jnp.matmul)

    def job() -> None:
        for _ in range(products):
            product = multiply(a, b)
        jax.block_until_ready(product)

    return job


def configured(config: TrainConfig, compute: str) -> TrainConfig:
    """The preset with another type."""
    return dataclasses.replace(config, model=dataclasses.replace(config.model, compute=compute))


def measured(make: Callable[[], Work], compute: str, timing: Timing) -> dict[str, Any]:
    """Time work against matrix products in turn. If the device refuses it, for want of memory say, the reason."""
    peak_before = _peak_bytes()
    try:
        work = make()
        size = timing.size or (2048 if jax.devices()[0].platform == "cpu" else 8192)
        jobs = [clocked(work.job), clocked(product_job(compute, size, timing.products))]
        seconds = in_turn(jobs, repeats=timing.repeats)
        needs = work.program().memory_analysis()
    except (jax.errors.JaxRuntimeError, FloatingPointError) as error:
        return {"error": in_short(error)}
    rates, peaks = (np.array([timing.calls * work.flops, timing.products * 2.0 * size**3]) / seconds).T
    peak_after, nominal = _peak_bytes(), timing.peak_tflops if compute == NOMINAL_TYPE else None
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
        "nominal_tflops": nominal,
        "share_of_nominal": None if nominal is None else rate / (nominal * 1e12),
        "program_bytes": None
        if needs is None
        else needs.argument_size_in_bytes
        + needs.output_size_in_bytes
        + needs.temp_size_in_bytes
        - needs.alias_size_in_bytes,
        "peak_bytes": None if peak_after == peak_before else peak_after,
    }


def _peak_bytes() -> int | None:
    """Maximum memory of the device that this process has used, in bytes. None if the device does not tell."""
    return (jax.devices()[0].memory_stats() or {}).get("peak_bytes_in_use")


def about_device() -> dict[str, str]:
    """The device, and what is needed to repeat a measurement."""
    return {"device": jax.devices()[0].device_kind, **about("jax", "jaxlib", "optax")}


def training(
    *,
    preset: tuple[str, ...] = ("sglpr",),
    compute: tuple[str, ...] = (),
    labels: bool = True,
    repeats: int = 10,
    steps: int = 2,
    size: int | None = None,
) -> None:
    """Time training steps and matrix products in turn: tuples a second, and the share of the device's peak.

    The step is all but reading, on a random batch that is on the device. Its operations are those of matrix products
    and convolutions, forward and backward. The peak is the rate of large square products of the same type, at the
    precision JAX has by default.

    Args:
        preset: files of configs/ by name, or paths.
        compute: float32, bfloat16; none named: float32, and on other devices than a CPU bfloat16 too.
        labels: whether the clouds have them; without them the segmentation head is not computed.
        repeats: how often steps and products are timed in turn.
        steps: steps in one timing.
        size: rows and columns of the matrices; none: 2048 on a CPU, 8192 elsewhere.
    """
    types = compute or (("float32",) if jax.devices()[0].platform == "cpu" else ("float32", "bfloat16"))
    columns = ("tuples/s", "images/s", "GFLOP/step", "GFLOP/s", "peak GFLOP/s", "share", "spread")
    table = Table("preset", "compute", "tuples/step", *columns)
    for name in preset:
        for type_ in types:
            config = configured(load_preset(name), type_)
            timing = Timing(repeats, steps, size)
            row = measured(lambda config=config: step_work(config, steps, labels=labels), type_, timing)
            if "error" in row:  # such as no memory
                table.add(name, type_, config.tuples, row["error"], *[""] * (len(columns) - 1))
                continue
            giga = (row[key] / 1e9 for key in ("flop", "flop_per_second", "peak_flop_per_second"))
            numbers = (config.tuples / row["seconds"], row["images_per_second"], *giga)
            spread = " to ".join(f"{share:.3f}" for share in row["share_of_peak_spread"])
            cells = (f"{number:.4g}" for number in numbers)
            table.add(name, type_, config.tuples, *cells, f"{row['share_of_peak']:.3f}", spread)
    print("Share: of the peak, medians of what was measured in turn. Spread: its 10 % and 90 % quantiles.")
    print("\n".join(f"{name}: {value}" for name, value in about_device().items()))
    print(f"peak of memory: {peak_mb():.0f} MB, with GLIBC_TUNABLES={os.environ.get('GLIBC_TUNABLES', '')}")
