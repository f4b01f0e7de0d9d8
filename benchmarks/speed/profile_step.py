"""Where the time of a training step goes: part by part of the network, forward and backward, beside its floor.

    python -m benchmarks.speed.profile_step --preset circular sglpr

JAX's profiler tells how long each compiled operation ran, and its metadata which line of the network it comes from. The
floor of a part is what its matrix products and convolutions would take at the rate of one large matrix product.
"""

import dataclasses
import re
import tempfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import tyro
from rich.console import Console
from rich.table import Table

from benchmarks.speed.flops import flops_by_name
from benchmarks.speed.inputs import random_batch
from benchmarks.speed.throughput import best_rate, product_job
from sglpr_jax.training.config import TrainConfig
from sglpr_jax.training.presets import load_preset
from sglpr_jax.training.state import new_state
from sglpr_jax.training.step import train_step

WRAPPER = re.compile(r"^\w+\((.*)\)$")
BACKWARD = "transpose("
WITHOUT_TIME = ("call", "while", "conditional")
"""Operations whose time is that of those inside them."""
REST = "images, losses, optimiser"
WARM_UP = 4
"""Steps before: the memory of the first ones comes from the system page by page."""
EXECUTION = "ThunkExecutor::Execute"
"""How the profiler calls the run of a whole program."""
OPERATION = re.compile(r"^\s*(?:ROOT )?%?(\S+) = .*? ([\w-]+)\(.*op_name=\"([^\"]*)\"", re.MULTILINE)
"""In the text of a compiled program: an operation's name, its kind, and where in the Python program it comes from."""


def main(
    *, preset: tuple[str, ...] = ("circular", "sglpr"), steps: int = 3, labels: bool = True, depth: int = 2
) -> None:
    """Print a table for each preset.

    Args:
        preset: files of configs/ by name, or paths.
        steps: steps that are measured, after four that are not.
        labels: whether the clouds have them; without them the segmentation head is not computed.
        depth: how many modules deep the network is taken apart.
    """
    size = 2048
    peak = best_rate(product_job("float32", size, 4), 4 * 2 * size**3, repeats=5)
    for name in preset:
        config = load_preset(name)
        batch = jax.device_put(random_batch(config, config.max_points, labels=labels))
        milliseconds, floors, wall = profiled(config, batch, steps, depth, peak)
        Console(width=120, highlight=False).print(table(name, milliseconds, floors, wall, peak))


def profiled(
    config: TrainConfig, batch: Any, steps: int, depth: int, peak: float
) -> tuple[Counter[tuple[str, bool]], Counter[tuple[str, bool]], float]:
    """Milliseconds a step by part and direction, measured and at least, and those of a whole step."""
    state = new_state(config)
    program = train_step.lower(state, batch, config=config).compile()
    for _ in range(WARM_UP):
        state, _ = program(state, batch)
    jax.block_until_ready(state)  # or they would be measured too
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            for _ in range(steps):
                state, metrics = program(state, batch)
            jax.block_until_ready(metrics)
        events = list(timed_operations(Path(folder)))
    origin = {name: where for name, kind, where in OPERATION.findall(program.as_text()) if kind not in WITHOUT_TIME}
    milliseconds: Counter[tuple[str, bool]] = Counter()
    for name, nanoseconds in events:
        if name in origin:
            milliseconds[part_of(origin[name], depth)] += nanoseconds / 1e6 / steps
    whole = dataclasses.replace(config, chunk=0)
    traced = train_step.trace(jax.eval_shape(lambda: new_state(whole)), batch, config=whole).jaxpr
    floors: Counter[tuple[str, bool]] = Counter()
    for where, flops in flops_by_name(traced).items():
        floors[part_of(where, depth)] += 1e3 * flops / peak
    wall = sum(nanoseconds for name, nanoseconds in events if name == EXECUTION) / 1e6 / steps
    return milliseconds, floors, wall


def timed_operations(folder: Path) -> Iterator[tuple[str, float]]:
    """Name and nanoseconds of everything the profiler saw."""
    (file,) = folder.rglob("*.xplane.pb")
    for plane in jax.profiler.ProfileData.from_file(str(file)).planes:
        for line in plane.lines:
            yield from ((event.name, event.duration_ns) for event in line.events)


def part_of(where: str, depth: int) -> tuple[str, bool]:
    """The part of the network that an operation is of, and whether it is of the backward pass."""
    modules: list[str] = []
    for step in split_path(where):
        while wrapped := WRAPPER.match(step):
            step = wrapped[1]
        modules += step.split("/")
    if "SGLPR" not in modules:
        return REST, False
    inside = modules[modules.index("SGLPR") + 1 :][:-1]  # the last is the operation itself
    return "/".join(inside[:depth]) or "between the parts", BACKWARD in where


def split_path(where: str) -> list[str]:
    """At the slashes that are in no brackets: transpose(jvp(a/b))/c is two steps."""
    steps, open_brackets = [""], 0
    for letter in where:
        open_brackets += {"(": 1, ")": -1}.get(letter, 0)
        if letter == "/" and not open_brackets:
            steps.append("")
        else:
            steps[-1] += letter
    return steps


def table(
    name: str, milliseconds: Counter[tuple[str, bool]], floors: Counter[tuple[str, bool]], wall: float, peak: float
) -> Table:
    """The parts, dearest first."""
    total = sum(milliseconds.values())
    made = Table("part", "forward ms", "floor", "backward ms", "floor", "share", title=name)
    parts = {part for part, _ in milliseconds | floors}
    for part in sorted(parts, key=lambda part: -milliseconds[part, False] - milliseconds[part, True]):
        times = [each[part, backward] for backward in (False, True) for each in (milliseconds, floors)]
        share = (times[0] + times[2]) / total
        made.add_row(part, *(f"{time:.1f}" for time in times), f"{share:.1%}")
    made.caption = (
        f"all operations {total:.0f} ms a step, in {wall:.0f} ms; floor {sum(floors.values()):.0f} ms at "
        f"{peak / 1e9:.0f} GFLOP/s: {sum(floors.values()) / wall:.0%} of the peak"
    )
    return made


if __name__ == "__main__":
    tyro.cli(main)
