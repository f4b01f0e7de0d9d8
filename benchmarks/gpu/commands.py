"""The three commands for a GPU: each stops when its time is over, and goes on there when it is given once more."""

import argparse
import dataclasses
import functools
import math
import time
from collections.abc import Callable, Iterator, Mapping
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
from sglpr_jax.training.recipe import TrainResult
from sglpr_jax.training.recipe import train as train_network
from sglpr_jax.training.run_folder import CONFIG_FILE
from sglpr_jax.training.trainer import METRICS_FILE

Row = dict[str, Any]
MOST_FILES = 8
MOST_BYTES = 16 * 10**6
"""Of one file."""
HEADER_BYTES = 10**5
"""Room for what a file of weights has beside its numbers."""
SUMMARY_FILE = "summary.json"
MOST_LINES = 2000
"""Of the measurements in a summary; the run's folder has all."""
Stopped = Callable[[], bool]
Asked = argparse.Namespace


class KeptRows:
    """A table in a JSON file that is written after each row: a program that is cut goes on there.

    `about` is written beside the rows. Raises ValueError if the file that is there is no such table.
    """

    def __init__(self, path: Path, *, about: Mapping[str, Any]):
        self._path, self._about = path, about
        found = read_json(path) if path.exists() else {"rows": []}
        rows = found.get("rows") if isinstance(found, dict) else None
        if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
            raise ValueError(f"{path}: expected a table with rows, found none; remove the file to measure all anew")
        self.rows: list[Row] = rows

    def find(self, key: Row) -> Row | None:
        """The row with the values of `key`."""
        return next((row for row in self.rows if key.items() <= row.items()), None)

    def add(self, key: Row, measure: Callable[[], Row]) -> None:
        """Measure a row and write it, unless it is there. Raises WriteError if the file cannot be written."""
        if self.find(key) is None:
            self.rows.append({**key, **measure()})
            write_json(self._path, {"rows": self.rows, **self._about})


def half_fits(parameters: int) -> bool:
    """Whether so many weights fit one file as float16."""
    return 2 * parameters + HEADER_BYTES <= MOST_BYTES


def told(folder: Path) -> str:
    """One line on what a folder of results holds, and whether that is more than can be counted on to be copied."""
    sizes = {path: path.stat().st_size for path in sorted(folder.rglob("*")) if path.is_file()}
    large = [str(path) for path, size in sizes.items() if size > MOST_BYTES]
    found = f"{folder}: {len(sizes)} files, {sum(sizes.values()) / 1e6:.1f} MB"
    if large or len(sizes) > MOST_FILES:
        found += f" (expected at most {MOST_FILES} files of {MOST_BYTES / 1e6:.0f} MB; too large: {large or 'none'})"
    return found


class OutOfTime(Exception):
    """The time for a dataset is over; it can be gone on with."""


def simulate(asked: Asked, stopped: Stopped) -> tuple[str, bool]:
    """Measure the rates of the simulator and of images, then write what is missing of a dataset."""
    rows, device = KeptRows(asked.results / "simulate.json", about=about_device()), {"device": _device()}
    sizes = {"batch": asked.batch, "points": asked.points, "repeats": asked.repeats}
    route, scans = asked.seq[0], max(asked.batch, 2)
    for key, measure in measurements(asked.sensor, asked.azimuth_steps, route=route, scans=scans, **sizes):
        if stopped():
            return _scans_in_words(asked), False
        rows.add(key | device, measure)
    if not _is_whole(asked) and not stopped():
        call = 1 + sum(row["what"] == "dataset" for row in rows.rows)
        key = {"what": "dataset", "call": call, "out": str(asked.out), "layout": asked.layout}
        rows.add(key | device, lambda: _write(asked, stopped))
    return _scans_in_words(asked), _is_whole(asked)


def _write(asked: Asked, stopped: Stopped) -> Row:
    """Write scans until all are there or the time is over; how many a second, building and compiling included."""

    def look(done: int) -> None:
        if stopped():
            raise OutOfTime

    options = {name: getattr(asked, name) for name in ("scans", "sensor", "azimuth_steps", "seed")}
    images, vary = asked.layout != "scans", asked.layout == "varied"
    before, start, finished = _scans_there(asked), time.perf_counter(), False
    try:
        simulate_dataset(asked.out, routes=tuple(asked.seq), images=images, vary=vary, on_progress=look, **options)
        finished = True
    except OutOfTime:
        pass
    seconds, made = time.perf_counter() - start, _scans_there(asked) - before
    return {"scans": made, "seconds": seconds, "scans_per_second": made / seconds, "finished": finished}


def _scans_there(asked: Asked) -> int:
    """How many scans are on the disk."""
    files_of = LAYOUTS[asked.layout].files_of_scan
    scans = ((name, f"{i:06d}") for name in asked.seq for i in range(asked.scans))
    return sum(all(file.exists() for file in files_of(asked.out, name, id)) for name, id in scans)


def _is_whole(asked: Asked) -> bool:
    """Whether all of the dataset is on the disk."""
    sensor = lidar(asked.sensor, asked.azimuth_steps)
    missing = Simulated(asked.out, tuple(asked.seq), asked.scans, asked.layout, sensor).missing
    return not missing and _scans_there(asked) == asked.scans * len(asked.seq)


def _scans_in_words(asked: Asked) -> str:
    return f"{_scans_there(asked)} of {asked.scans * len(asked.seq)} scans in {asked.out}"


def train(asked: Asked, stopped: Stopped) -> tuple[str, bool]:
    """Train a preset until all steps are made or the time is over, test what there is, and write small results.

    The summary is RUN.json in the results, RUN being the name of the run's folder; weights go to the folder RUN there
    if they fit as float16. Nothing is tested again if no step was made since.
    """
    changes = {name: getattr(asked, name) for name in ("chunk", "steps") if getattr(asked, name) is not None}
    config = dataclasses.replace(configured(load_preset(asked.preset), asked.compute), **changes)
    recordings, test = leave_one_out(asked.data, asked.test)
    settings = {"data": str(asked.data), "preset": asked.preset, "test": asked.test}
    try:
        result = train_network(
            config,
            recordings,
            out=asked.out,
            test=test,
            resume=(asked.out / CONFIG_FILE).exists(),
            cache=asked.packs,
            callback=ProgressBar(),
            stopped=stopped,
            settings=settings,
        )
    except KeyboardInterrupt:  # how `train` stops while it packs recordings
        if not stopped():
            raise
        return f"recordings are packed in {asked.packs}", False
    path = asked.out / SUMMARY_FILE
    summary = read_json(path) if path.exists() else {}
    if summary.get("steps_made") != result.steps:
        scores = final_test(result.params, test, asked.out / "test", methods=()).to_json()
        summary = {**settings, "steps_made": result.steps, "scores": scores, **about_device()}
    summary |= _how_it_went(result) | {"weights": _hand_out(result, asked.results)}
    write_json(path, summary)
    write_json(asked.results / f"{asked.out.name}.json", summary)
    return str(result), result.finished


def _how_it_went(result: TrainResult) -> dict[str, Any]:
    """Steps, speed and measurements: all scores, and of the other lines every n-th."""
    config, speed, lines = result.config, result.throughput, read_metrics(result.folder / METRICS_FILE)
    every = math.ceil(len(lines) / MOST_LINES)
    return {
        "steps": config.steps,
        "finished": result.finished,
        "compute": config.model.compute,
        "tuples": config.tuples,
        "chunk": config.chunk,
        "speed": None if speed is None else dataclasses.asdict(speed),
        "metrics": [line for i, line in enumerate(lines) if "score" in line or i % every == 0],
    }


def _hand_out(result: TrainResult, results: Path) -> str:
    """Write the weights if they fit; says where they are."""
    parameters = sum(leaf.size for leaf in jax.tree.leaves(result.params.weights))
    if not half_fits(parameters):
        return f"in the run's folder alone: {parameters} parameters, as float16 {2 * parameters / 1e6:.0f} MB"
    save(result.params, results / result.folder.name, half=True)
    return f"{result.folder.name}, as float16: {parameters} parameters"


def measure(asked: Asked, stopped: Stopped) -> tuple[str, bool]:
    """Measure descriptors and training steps of presets, those rows that are not in measure.json yet."""
    rows = KeptRows(asked.results / "measure.json", about=about_device())
    timing = Timing(asked.repeats, asked.calls, asked.size, asked.products, asked.peak_tflops)
    changes = {} if asked.chunk is None else {"chunk": asked.chunk}
    presets = {name: dataclasses.replace(load_preset(name), **changes) for name in asked.preset}
    for name, preset in presets.items():
        for compute in asked.compute:
            for key, work in _jobs(configured(preset, compute), asked):
                key = {"preset": Path(name).stem, "compute": compute, "device": _device(), **key}
                if rows.find(key) is not None:
                    continue
                if stopped():
                    return "presets", False
                rows.add(key, functools.partial(measured, work, compute, timing))
                print(_in_words(rows.rows[-1]), flush=True)
    return "presets", True


def _jobs(config: TrainConfig, asked: Asked) -> Iterator[tuple[Row, Callable[[], Any]]]:
    """The key of each row of a model, and its work; rows that need less memory first."""
    for batch in asked.batch:
        yield {"what": "describe", "images": batch}, functools.partial(describe_work, config, batch, asked.calls)
    key = {"what": "step", "images": config.images, "chunk": config.chunk}
    yield key, functools.partial(step_work, config, asked.calls)


def _in_words(row: Row) -> str:
    name = f"{row['preset']}, {row['compute']}, {row['what']} of {row['images']} image(s)"
    if "error" in row:
        return f"{name}: {row['error']}"
    return f"{name}: {1e3 * row['seconds']:.4g} ms, {row['share_of_peak']:.3f} of the measured peak"


def _device() -> str:
    return about_device()["device"]
