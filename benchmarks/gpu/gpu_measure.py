"""Presets on this device, row by row: training steps and descriptors in each type, see `model_rates.py`."""

import dataclasses
import functools
from collections.abc import Callable, Iterator
from pathlib import Path

from benchmarks.gpu.kept_rows import KeptRows, Row
from benchmarks.gpu.model_rates import Timing, describe_work, measured, step_work
from benchmarks.speed.throughput import about, configured
from sglpr_jax.training.config import TrainConfig
from sglpr_jax.training.presets import load_preset

FILE = "measure.json"


@dataclasses.dataclass(frozen=True)
class MeasureConfig:
    """What is measured."""

    presets: tuple[str, ...]
    compute: tuple[str, ...]
    batches: tuple[int, ...]
    """Images that are described in one call."""
    chunk: int | None
    """Images of a step through the network at a time, 0: all. None: the preset's."""
    timing: Timing


def measure_presets(config: MeasureConfig, results: Path, stopped: Callable[[], bool]) -> bool:
    """Measure the rows that are not in measure.json in `results` yet, until all are or `stopped`; whether all are.

    Raises ValueError for a preset that is not there, or cannot be changed so.
    """
    rows, device = KeptRows(results / FILE, about=about()), {"device": about()["device"]}
    models = [(name, *each) for name in config.presets for each in _types(name, config)]
    jobs = [(key | device, measure) for model in models for key, measure in _jobs(*model, config)]
    for key, measure in jobs:
        if rows.find(key) is not None:
            continue
        if stopped():
            return False
        rows.add(key, measure)
        print(in_words(rows.rows[-1]), flush=True)
    return True


def _types(name: str, config: MeasureConfig) -> Iterator[tuple[str, TrainConfig]]:
    """The preset in each type."""
    changes = {} if config.chunk is None else {"chunk": config.chunk}
    preset = dataclasses.replace(load_preset(name), **changes)
    yield from ((compute, configured(preset, compute, None)) for compute in config.compute)


def _jobs(
    name: str, compute: str, model: TrainConfig, config: MeasureConfig
) -> Iterator[tuple[Row, Callable[[], Row]]]:
    """Of each row its key, and what measures the rest of it; those that need less memory first."""
    row = {"preset": Path(name).stem, "compute": compute}
    measure = functools.partial(measured, compute=compute, timing=config.timing)
    calls = config.timing.calls
    for batch in config.batches:
        work = functools.partial(describe_work, model, batch, calls)
        yield {**row, "what": "describe", "images": batch}, functools.partial(measure, work)
    step = {**row, "what": "step", "images": model.images, "chunk": model.chunk}
    yield step, functools.partial(measure, functools.partial(step_work, model, calls))


def in_words(row: Row) -> str:
    """A row in one line."""
    name = f"{row['preset']}, {row['compute']}, {row['what']} of {row['images']} image(s)"
    if "error" in row:
        return f"{name}: {row['error']}"
    return f"{name}: {1e3 * row['seconds']:.4g} ms, {row['share_of_peak']:.3f} of the measured peak"
