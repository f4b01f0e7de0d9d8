"""What learning semantics costs: training steps with every n-th image segmented, against the step without labels."""

import dataclasses
import time
from pathlib import Path

import jax
import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from benchmarks.speed.inputs import random_batch
from benchmarks.speed.ratio import SPREAD
from benchmarks.speed.throughput import StepJob, about
from sglpr_jax.data.sampling.batch import Batch
from sglpr_jax.files import write_json
from sglpr_jax.training.config import TrainConfig
from sglpr_jax.training.presets import load_preset


def main(
    *,
    preset: tuple[str, ...] = ("sglpr",),
    every: tuple[int, ...] = (4, 2),
    detail: tuple[int, ...] = (),
    repeats: int = 8,
    out: Path | None = None,
) -> None:
    """Time the steps of one preset in turn, in one process, on random batches that are on the device already.

    Args:
        preset: files of configs/ by name, or paths.
        every: of how many images of a step one is segmented.
        detail: channels of the layer that shows the image to the segmentation head; none named: the preset's.
        repeats: how often each step is timed.
        out: a JSON file to write.
    """
    rows = []
    for name in preset:
        config = load_preset(name)
        variants = [(n, size) for size in detail or (config.model.detail,) for n in every]
        seconds = measure(config, variants, repeats)
        rows += summaries(Path(name).stem, variants, seconds)
    Console(width=120, highlight=False).print(table(rows))
    print(f"Ratios are formed within each of {repeats} repeats. Spread: their 10 % and 90 % quantiles.")
    made_with = about()
    print("\n".join(f"{name}: {text}" for name, text in made_with.items()))
    if out is not None:
        write_json(out, {"rows": rows, **made_with})


def measure(config: TrainConfig, variants: list[tuple[int, int]], repeats: int) -> np.ndarray:
    """Seconds of each step, (repeats, 1 + variants), the first of them without labels; the order changes in turn."""
    unlabelled = StepJob(config, _batch(config, labels=False), 1)
    segmented = [segmenting(config, every, detail) for every, detail in variants]
    jobs = [unlabelled, *(StepJob(one, _batch(one, labels=True), 1) for one in segmented)]
    for job in jobs:
        job()  # compiles
    seconds = np.zeros((repeats, len(jobs)))
    for repeat in range(repeats):
        for i in range(len(jobs))[:: -1 if repeat % 2 else 1]:
            start = time.perf_counter()
            jobs[i]()
            seconds[repeat, i] = time.perf_counter() - start
    return seconds


def segmenting(config: TrainConfig, every: int, detail: int) -> TrainConfig:
    """The preset with another share of its images segmented, by another head."""
    loss = dataclasses.replace(config.loss, segment_every=every)
    return dataclasses.replace(config, loss=loss, model=dataclasses.replace(config.model, detail=detail))


def _batch(config: TrainConfig, *, labels: bool) -> Batch:
    return jax.device_put(random_batch(config, config.max_points, labels=labels))


def summaries(preset: str, variants: list[tuple[int, int]], seconds: np.ndarray) -> list[dict]:
    """What is reported of each variant of one preset."""
    ratios = np.quantile(seconds[:, 1:] / seconds[:, :1], (SPREAD[0], 0.5, SPREAD[1]), axis=0).T.tolist()
    medians = np.median(seconds, axis=0).tolist()
    return [
        {
            "preset": preset,
            "every": every,
            "detail": detail,
            "unlabelled_s": medians[0],
            "segmented_s": median,
            "ratio": middle,
            "spread": (low, high),
        }
        for (every, detail), median, (low, middle, high) in zip(variants, medians[1:], ratios, strict=True)
    ]


def table(rows: list[dict]) -> Table:
    """One row for each variant."""
    made = Table(
        "preset", "one image segmented of", "detail", "without labels, s", "with, s", "with / without", "spread"
    )
    for row in rows:
        low, high = row["spread"]
        seconds = f"{row['unlabelled_s']:.3f}", f"{row['segmented_s']:.3f}"
        cells = row["preset"], str(row["every"]), str(row["detail"]), *seconds
        made.add_row(*cells, f"{row['ratio']:.2f}", f"{low:.2f} to {high:.2f}")
    return made


if __name__ == "__main__":
    tyro.cli(main)
