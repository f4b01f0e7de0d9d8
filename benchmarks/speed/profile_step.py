"""Time of a training step by parts of the network, forward and backward, and the minimum time by the device's peak.

JAX's profiler measures each compiled operation. The operation's metadata names the module that it comes from.
"""

import re
import tempfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax

from benchmarks.speed.inputs import random_batch
from benchmarks.speed.training import product_job, step_flops
from benchmarks.table import Table
from benchmarks.timing import clocked, in_turn
from sglpr_jax.training.config import TrainConfig
from sglpr_jax.training.image_network import ImageNetwork
from sglpr_jax.training.presets import load_preset
from sglpr_jax.training.step import train_step

WRAPPER = re.compile(r"^\w+\((.*)\)$")
BACKWARD = "transpose("
WITHOUT_TIME = ("call", "while", "conditional")
"""Operations whose time is that of those inside them."""
REST = "images, losses, optimiser"
DEPTH = 2
"""How many modules deep the network is taken apart."""
WARM_UP = 4
"""Steps before: the memory of the first ones comes from the system page by page."""
EXECUTION = "ThunkExecutor::Execute"
"""How the profiler calls the run of a whole program."""
OPERATION = re.compile(r"^\s*(?:ROOT )?%?(\S+) = .*? ([\w-]+)\(.*op_name=\"([^\"]*)\"", re.MULTILINE)
"""In the text of a compiled program: an operation's name, its kind, and where in the Python program it comes from."""


def profile(*, preset: tuple[str, ...] = ("sglpr-small", "sglpr"), steps: int = 3) -> None:
    """Print the time of each part of a training step, a table for each preset.

    Args:
        preset: files of configs/ by name, or paths.
        steps: steps that are measured, after four that are not.
    """
    size = 2048
    peak = 4 * 2 * size**3 / in_turn([clocked(product_job("float32", size, 4))], repeats=5).min()
    for name in preset:
        config = load_preset(name)
        batch = jax.device_put(random_batch(config, config.max_points))
        milliseconds, wall = _profiled(config, batch, steps)
        total, floor = sum(milliseconds.values()), 1e3 * step_flops(config, batch) / peak
        table = Table(name, "forward ms", "backward ms", "share")
        parts = {part for part, _ in milliseconds}
        for part in sorted(parts, key=lambda part: -milliseconds[part, False] - milliseconds[part, True]):
            times = [milliseconds[part, backward] for backward in (False, True)]
            table.add(part, *(f"{time:.1f}" for time in times), f"{sum(times) / total:.1%}")
        print(f"all operations {total:.0f} ms a step, in {wall:.0f} ms: {floor / wall:.0%} of {peak / 1e9:.0f} GFLOP/s")


def _profiled(config: TrainConfig, batch: Any, steps: int) -> tuple[Counter[tuple[str, bool]], float]:
    """Milliseconds a step by part and direction, and those of a whole step."""
    network = ImageNetwork(config)
    state = network.new_state()
    program = train_step.lower(state, batch, network=network).compile()
    for _ in range(WARM_UP):
        state, _ = program(state, batch)
    jax.block_until_ready(state)  # or they would be measured too
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            for _ in range(steps):
                state, metrics = program(state, batch)
            jax.block_until_ready(metrics)
        events = list(_timed_operations(Path(folder)))
    origin = {name: where for name, kind, where in OPERATION.findall(program.as_text()) if kind not in WITHOUT_TIME}
    milliseconds: Counter[tuple[str, bool]] = Counter()
    for name, nanoseconds in events:
        if name in origin:
            milliseconds[_part_of(origin[name])] += nanoseconds / 1e6 / steps
    return milliseconds, sum(nanoseconds for name, nanoseconds in events if name == EXECUTION) / 1e6 / steps


def _timed_operations(folder: Path) -> Iterator[tuple[str, float]]:
    """Name and nanoseconds of everything the profiler saw."""
    (file,) = folder.rglob("*.xplane.pb")
    for plane in jax.profiler.ProfileData.from_file(str(file)).planes:
        for line in plane.lines:
            yield from ((event.name, event.duration_ns) for event in line.events)


def _part_of(where: str) -> tuple[str, bool]:
    """Part of the network of an operation, from the path in its metadata, and whether it is in the backward pass."""
    modules: list[str] = []
    for step in _split_path(where):
        while wrapped := WRAPPER.match(step):
            step = wrapped[1]
        modules += step.split("/")
    if "SGLPR" not in modules:
        return REST, False
    inside = modules[modules.index("SGLPR") + 1 :][:-1]  # the last is the operation itself
    return "/".join(inside[:DEPTH]) or "between the parts", BACKWARD in where


def _split_path(where: str) -> list[str]:
    """Splits a path at the slashes outside brackets: transpose(jvp(a/b))/c has two steps."""
    steps, open_brackets = [""], 0
    for letter in where:
        open_brackets += {"(": 1, ")": -1}.get(letter, 0)
        if letter == "/" and not open_brackets:
            steps.append("")
        else:
            steps[-1] += letter
    return steps
