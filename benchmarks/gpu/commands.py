"""The three commands for a GPU: each stops when its time is over, and continues there when it is started again."""

import argparse
import contextlib
import dataclasses
import functools
import math
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax

from benchmarks.drives import lidar
from benchmarks.gpu.simulator_rates import measurements
from benchmarks.speed.training import Timing, about_device, configured, describe_work, measured, step_work
from sglpr_jax.data.training_recordings import leave_one_out
from sglpr_jax.evaluation.final_test import final_test
from sglpr_jax.files import read_json, write_json
from sglpr_jax.models.weights_file import save
from sglpr_jax.sim.dataset import Simulated
from sglpr_jax.sim.dataset import simulate as simulate_dataset
from sglpr_jax.sim.layouts import LAYOUTS
from sglpr_jax.training.callbacks import ProgressBar
from sglpr_jax.training.config import TrainConfig
from sglpr_jax.training.metrics_log import read_metrics
from sglpr_jax.training.presets import load_preset
from sglpr_jax.training.recipe import PackingStopped, TrainResult
from sglpr_jax.training.recipe import train as train_network
from sglpr_jax.training.run_folder import CONFIG_FILE
from sglpr_jax.training.trainer import METRICS_FILE

Row = dict[str, Any]
Stopped = Callable[[], bool]
Flags = argparse.Namespace
MAX_FILES, MAX_BYTES = 8, 16 * 10**6
"""Maximum number of files in the results, and maximum size of one."""
HEADER_BYTES = 10**5
"""Room for what a file of weights has beside its numbers."""
SUMMARY_FILE = "summary.json"
MAX_LINES = 2000
"""Maximum number of measurements in a summary; the run's folder has all."""


class StoredRows:
    """A table in a JSON file that is written after each row, so that an interrupted program continues there.

    The device is written beside the rows. Raises ValueError if the file that exists is no such table.
    """

    def __init__(self, path: Path):
        self._path, self._about = path, about_device()
        content = read_json(path) if path.exists() else {"rows": []}
        rows = content.get("rows") if isinstance(content, dict) else None
        if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
            raise ValueError(f"{path}: expected a table with rows, found none; remove the file to measure all anew")
        self.rows: list[Row] = rows

    def has(self, key: Row) -> bool:
        """Whether there is a row with the values of `key` of this device."""
        return any((key | {"device": self._about["device"]}).items() <= row.items() for row in self.rows)

    def add(self, key: Row, measure: Callable[[], Row]) -> None:
        """Measure a row and write it. Raises WriteError if the file cannot be written."""
        self.rows.append({**key, "device": self._about["device"], **measure()})
        write_json(self._path, {"rows": self.rows, **self._about})


def summary_of(folder: Path) -> str:
    """One line about a folder of results, with a warning if it is too large to be copied."""
    sizes = {path: path.stat().st_size for path in sorted(folder.rglob("*")) if path.is_file()}
    large = [str(path) for path, size in sizes.items() if size > MAX_BYTES]
    line = f"{folder}: {len(sizes)} files, {sum(sizes.values()) / 1e6:.1f} MB"
    if large or len(sizes) > MAX_FILES:
        line += f" (expected at most {MAX_FILES} files of {MAX_BYTES / 1e6:.0f} MB; too large: {large or 'none'})"
    return line


class OutOfTime(Exception):
    """The time for a dataset is over. The dataset can be continued."""


def simulate(flags: Flags, stopped: Stopped) -> tuple[str, bool]:
    """Measure the rates of the simulator and of images, then write what is missing of a dataset."""
    rows, sensor = StoredRows(flags.results / "simulate.json"), lidar(flags.sensor, flags.azimuth_steps)
    for key, measure in measurements(flags.sensor, sensor, route=flags.seq[0]):
        if not rows.has(key) and not stopped():
            rows.add(key, measure)
    dataset = Simulated(flags.out, tuple(flags.seq), flags.scans, flags.layout, sensor)
    wanted = flags.scans * len(flags.seq)
    if (dataset.missing or _scans_in(flags) < wanted) and not stopped():
        call = 1 + sum(row["what"] == "dataset" for row in rows.rows)
        key = {"what": "dataset", "call": call, "out": str(flags.out), "layout": flags.layout}
        rows.add(key, lambda: _write_scans(flags, stopped))
    scans = _scans_in(flags)
    return f"{scans} of {wanted} scans in {flags.out}", scans == wanted and not dataset.missing


def _write_scans(flags: Flags, stopped: Stopped) -> Row:
    """Write scans until all exist or the time is over. The rate includes building the town and compiling."""

    def look(done: int) -> None:
        if stopped():
            raise OutOfTime

    options = {name: getattr(flags, name) for name in ("scans", "sensor", "azimuth_steps", "seed")}
    images, vary = flags.layout != "scans", flags.layout == "varied"
    before, start, finished = _scans_in(flags), time.perf_counter(), False
    with contextlib.suppress(OutOfTime):
        simulate_dataset(flags.out, routes=tuple(flags.seq), images=images, vary=vary, on_progress=look, **options)
        finished = True
    seconds, scans = time.perf_counter() - start, _scans_in(flags) - before
    return {"scans": scans, "seconds": seconds, "scans_per_second": scans / seconds, "finished": finished}


def _scans_in(flags: Flags) -> int:
    """Number of scans of the dataset on the disk."""
    files_of = LAYOUTS[flags.layout].files_of_scan
    scans = ((name, f"{i:06d}") for name in flags.seq for i in range(flags.scans))
    return sum(all(file.exists() for file in files_of(flags.out, name, scan)) for name, scan in scans)


def train(flags: Flags, stopped: Stopped) -> tuple[str, bool]:
    """Train a preset until all steps are made or the time is over, test the weights, and write small results.

    The summary is RUN.json in the results, RUN being the name of the run's folder; weights go to the folder RUN there
    if they fit as float16. Nothing is tested again if no step was made since.
    """
    changes = {name: getattr(flags, name) for name in ("chunk", "steps") if getattr(flags, name) is not None}
    config = dataclasses.replace(configured(load_preset(flags.preset), flags.compute), **changes)
    recordings, test = leave_one_out([flags.data], flags.test)
    settings = {"data": str(flags.data), "preset": flags.preset, "test": flags.test}
    try:
        result = train_network(
            config,
            recordings,
            out=flags.out,
            test=test,
            resume=(flags.out / CONFIG_FILE).exists(),
            cache=flags.packs,
            callback=ProgressBar(),
            stopped=stopped,
            settings=settings,
        )
    except PackingStopped:
        return f"recordings are packed in {flags.packs}", False
    path = flags.out / SUMMARY_FILE
    summary = read_json(path) if path.exists() else {}
    if summary.get("steps_made") != result.steps:
        scores = final_test(result.params, test, flags.out / "test", methods=()).to_json()
        summary = {**settings, "steps_made": result.steps, "scores": scores, **about_device()}
    summary |= _measurements_of(result) | {"weights": _copy_weights(result, flags.results)}
    write_json(path, summary)
    write_json(flags.results / f"{flags.out.name}.json", summary)
    return str(result), result.finished


def _measurements_of(result: TrainResult) -> dict[str, Any]:
    """Steps, speed and measurements: all scores, and of the other lines every n-th."""
    config, speed, lines = result.config, result.throughput, read_metrics(result.folder / METRICS_FILE)
    every = math.ceil(len(lines) / MAX_LINES)
    return {
        "steps": config.steps,
        "finished": result.finished,
        "compute": config.model.compute,
        "tuples": config.tuples,
        "chunk": config.chunk,
        "speed": None if speed is None else speed._asdict(),
        "metrics": [line for i, line in enumerate(lines) if "score" in line or i % every == 0],
    }


def _copy_weights(result: TrainResult, results: Path) -> str:
    """Write the weights to the results if they fit as float16, and return where they are."""
    parameters = sum(leaf.size for leaf in jax.tree.leaves(result.params.weights))
    if 2 * parameters + HEADER_BYTES > MAX_BYTES:
        return f"in the run's folder alone: {parameters} parameters, as float16 {2 * parameters / 1e6:.0f} MB"
    save(result.params, results / result.folder.name, half=True)
    return f"{result.folder.name}, as float16: {parameters} parameters"


def measure(flags: Flags, stopped: Stopped) -> tuple[str, bool]:
    """Measure descriptors and training steps of presets, those rows that are not in measure.json yet."""
    rows = StoredRows(flags.results / "measure.json")
    timing = Timing(flags.repeats, flags.calls, flags.size, flags.products, flags.peak_tflops)
    changes = {} if flags.chunk is None else {"chunk": flags.chunk}
    presets = {name: dataclasses.replace(load_preset(name), **changes) for name in flags.preset}
    for name, preset in presets.items():
        for compute in flags.compute:
            for job, work in _jobs(configured(preset, compute), flags):
                key = {"preset": Path(name).stem, "compute": compute, **job}
                if rows.has(key):
                    continue
                if stopped():
                    return "presets", False
                rows.add(key, functools.partial(measured, work, compute, timing))
                print(_line_of(rows.rows[-1]), flush=True)
    return "presets", True


def _jobs(config: TrainConfig, flags: Flags) -> Iterator[tuple[Row, Callable[[], Any]]]:
    """The key of each row of a model, and its work; rows that need less memory first."""
    for batch in flags.batch:
        yield {"what": "describe", "images": batch}, functools.partial(describe_work, config, batch, flags.calls)
    key = {"what": "step", "images": config.images, "chunk": config.chunk}
    yield key, functools.partial(step_work, config, flags.calls)


def _line_of(row: Row) -> str:
    name = f"{row['preset']}, {row['compute']}, {row['what']} of {row['images']} image(s)"
    if "error" in row:
        return f"{name}: {row['error']}"
    return f"{name}: {1e3 * row['seconds']:.4g} ms, {row['share_of_peak']:.3f} of the measured peak"
