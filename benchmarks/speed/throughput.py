"""Training steps against the device's own best: tuples a second, and the share of its matrix-multiply peak (MFU)."""

import dataclasses
import importlib.metadata
import os
import platform
import shlex
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.speed.flops import count_flops
from benchmarks.speed.inputs import random_batch
from benchmarks.speed.ratio import SPREAD
from sglpr_jax.data.sampling.batch import Batch
from sglpr_jax.files import write_json
from sglpr_jax.training.config import TrainConfig
from sglpr_jax.training.presets import load_preset
from sglpr_jax.training.state import new_state
from sglpr_jax.training.step import train_step

Job = Callable[[], Any]


def main(
    *,
    preset: tuple[str, ...] = ("sglpr",),
    compute: tuple[str, ...] = (),
    tuples: int | None = None,
    labels: bool = True,
    repeats: int = 10,
    steps: int = 2,
    size: int | None = None,
    products: int = 4,
    out: Path | None = None,
) -> None:
    """Time training steps and matrix products in turn, on one device, in one process.

    The step is the whole of it but reading: rasterising, where the preset trains on clouds, or rotating its images,
    forward, backward, optimiser, on a random batch that is on the device already. Its operations are those of matrix
    products and convolutions, forward and backward; what a step in chunks computes twice to save memory counts once.
    The peak is the rate of large square products of the same type, at the precision JAX has by default.

    Args:
        preset: files of configs/ by name, or paths.
        compute: float32, bfloat16; none named: float32, and on other devices than a CPU bfloat16 too.
        tuples: tuples a step; none: the preset's.
        labels: whether the clouds have them; without them the segmentation head is not computed.
        repeats: how often steps and products are timed in turn.
        steps: steps in one timing.
        size: rows and columns of the matrices; none: 2048 on a CPU, 8192 elsewhere.
        products: matrix products in one timing.
        out: a JSON file to write.
    """
    on_cpu = jax.devices()[0].platform == "cpu"
    compute = compute or (("float32",) if on_cpu else ("float32", "bfloat16"))
    size = size or matrix_size()
    rows = []
    for name in preset:
        for type_ in compute:
            config = configured(load_preset(name), type_, tuples)
            batch = jax.device_put(random_batch(config, config.max_points, labels=labels))
            flops = step_flops(config, batch)
            rates = measure(config, batch, flops, repeats=repeats, steps=steps, size=size, products=products)
            rows.append({"preset": Path(name).stem, "compute": type_, **summary(config, flops, *rates)})
    report = {"rows": rows, "labels": labels, **about()}
    Console(width=140, highlight=False).print(table(rows, title=f"training step on {report['device']}"))
    print("Share: of the peak, medians of what was measured in turn. Spread: its 10 % and 90 % quantiles.")
    print("\n".join(f"{name}: {report[name]}" for name in ("command", "versions", "machine")))
    if out is not None:
        write_json(out, report)


def configured(config: TrainConfig, compute: str, tuples: int | None) -> TrainConfig:
    """The preset with another type and size of step."""
    model = dataclasses.replace(config.model, compute=compute)
    return dataclasses.replace(config, model=model, tuples=tuples or config.tuples)


def step_flops(config: TrainConfig, batch: Batch) -> int:
    """Operations of a step's matrix products and convolutions; nothing is computed.

    Of the step in one piece: a step in chunks goes forward twice, and the second time is no work of the model's.
    """
    whole = dataclasses.replace(config, chunk=0)
    return count_flops(train_step.trace(jax.eval_shape(lambda: new_state(whole)), batch, config=whole).jaxpr)


def measure(
    config: TrainConfig, batch: Batch, flops: int, *, repeats: int, steps: int, size: int, products: int
) -> tuple[np.ndarray, np.ndarray]:
    """Operations a second of the training step and of matrix products, (repeats,) each."""
    product = product_job(config.model.compute, size, products)
    job = StepJob(config, batch, steps)
    return rates_in_turn((job, steps * flops), (product, products * 2 * size**3), repeats=repeats)


def rates_in_turn(ours: tuple[Job, float], other: tuple[Job, float], *, repeats: int) -> tuple[np.ndarray, np.ndarray]:
    """Operations a second of two jobs with their operations, (repeats,) each; the order changes in turn."""
    pair = ours, other
    for job, _ in pair:
        job()  # compiles
    rates = np.zeros((2, repeats))
    for repeat in range(repeats):
        for i in (0, 1) if repeat % 2 else (1, 0):
            job, work = pair[i]
            start = time.perf_counter()
            job()
            rates[i, repeat] = work / (time.perf_counter() - start)
    return rates[0], rates[1]


class StepJob:
    """A job: training steps, one after another."""

    def __init__(self, config: TrainConfig, batch: Batch, steps: int):
        self._config, self._batch, self._steps = config, batch, steps
        self._state = new_state(config)

    def __call__(self) -> None:
        """Make the steps. Raises FloatingPointError where the loss is no longer finite."""
        for _ in range(self._steps):
            self._state, metrics = train_step(self._state, self._batch, config=self._config)
        if not np.isfinite(metrics["loss"]):
            raise FloatingPointError(f"the loss is {metrics['loss']}: what was timed is no training")

    def program(self) -> jax.stages.Compiled:
        """The compiled step; after the first call nothing is compiled for it."""
        return train_step.lower(self._state, self._batch, config=self._config).compile()


def matrix_size() -> int:
    """Rows and columns of matrices that are large for this device."""
    return 2048 if jax.devices()[0].platform == "cpu" else 8192


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


def best_rate(job: Job, work: float, *, repeats: int) -> float:
    """Operations a second of a job that does `work` of them, in its fastest run."""
    job()  # compiles
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        job()
        seconds.append(time.perf_counter() - start)
    return work / min(seconds)


def summary(config: TrainConfig, flops: int, rates: np.ndarray, peaks: np.ndarray) -> dict[str, Any]:
    """What is reported of a preset."""
    steps_per_second = float(np.median(rates)) / flops
    low, middle, high = map(float, np.quantile(rates / peaks, (SPREAD[0], 0.5, SPREAD[1])))
    return {
        "tuples": config.tuples,
        "images": config.images,
        "tuples_per_second": steps_per_second * config.tuples,
        "images_per_second": steps_per_second * config.images,
        "flop_per_tuple": flops / config.tuples,
        "flop_per_second": float(np.median(rates)),
        "peak_flop_per_second": float(np.median(peaks)),
        "share_of_peak": middle,
        "share_of_peak_spread": (low, high),
    }


def about() -> dict[str, str]:
    """What is needed to repeat it."""
    versions = [f"{name} {importlib.metadata.version(name)}" for name in ("jax", "jaxlib", "optax")]
    load = ", ".join(f"{average:.1f}" for average in os.getloadavg())
    return {
        "device": jax.devices()[0].device_kind,
        "command": shlex.join(["python", *sys.argv]),
        "versions": ", ".join([f"Python {platform.python_version()}", *versions]),
        "machine": f"{os.cpu_count()} CPUs, load average {load} at the end",
    }


def table(rows: list[dict[str, Any]], *, title: str) -> Table:
    """One row for each preset and type."""
    columns = ("tuples/s", "images/s", "GFLOP/tuple", "GFLOP/s", "peak GFLOP/s", "share", "spread")
    made = Table("preset", "compute", "tuples/step", *columns, title=title)
    for row in rows:
        rates = (f"{row[name]:.4g}" for name in ("tuples_per_second", "images_per_second"))
        names = ("flop_per_tuple", "flop_per_second", "peak_flop_per_second")
        giga = (f"{row[name] / 1e9:.4g}" for name in names)
        spread = " to ".join(f"{share:.3f}" for share in row["share_of_peak_spread"])
        share = f"{row['share_of_peak']:.3f}"
        made.add_row(row["preset"], row["compute"], str(row["tuples"]), *rates, *giga, share, spread)
    return made


if __name__ == "__main__":
    import tyro  # here, for gpu.py uses the rest of this file where there is no tyro

    tyro.cli(main)
