"""Load: 100,000 scans in one embed; commands that are killed, run twice at once, or find the disk full or files gone.

    python -m benchmarks.robustness.load scans --method network
    python -m benchmarks.robustness.load kills
    python -m benchmarks.robustness.load together
    python -m benchmarks.robustness.load disk

Each part prints a table and, with --out, keeps it as JSON; with --quick it takes few scans, commands and tries.
"""

import abc
import dataclasses
import os
import shlex
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, TypeVar

import tyro
from rich.console import Console
from rich.progress import track
from rich.table import Table

import sglpr_jax
from benchmarks.robustness.disturbed import killed, together, troubled
from benchmarks.robustness.writers import WRITERS, Writer, make_inputs
from benchmarks.speed.many_scans import Watch, tiny_network, write_scans
from sglpr_jax.files import write_json
from sglpr_jax.methods.registry import method_named

QUICK = ("embed", "simulate images")
Row = dict[str, Any]
"""What a column is called, and what stands in it."""
T = TypeVar("T")


@dataclasses.dataclass(frozen=True)
class Part:
    """What all parts have."""

    quick: bool = False
    """Few of everything, to try it."""
    out: Path | None = None
    """A JSON file for the table."""


@dataclasses.dataclass(frozen=True)
class OfCommands(Part, abc.ABC):
    """What is done to the commands that write."""

    commands: tuple[str, ...] = ()
    """Of `writers.WRITERS`. None: all."""
    times: int = 20
    """How often each is disturbed."""
    seed: int = 0
    title: ClassVar[str]

    @abc.abstractmethod
    def rows(self, writer: Writer, folder: Path, times: int) -> Iterator[Row]:
        """Disturb a command so often; what came of it."""

    def run(self) -> None:
        names, rows = self.commands or (QUICK if self.quick else tuple(WRITERS)), []
        with tempfile.TemporaryDirectory() as folder:
            make_inputs(Path(folder))
            for name in track(names, console=Console(stderr=True), disable=not sys.stderr.isatty()):
                found = self.rows(WRITERS[name], Path(folder), 4 if self.quick else self.times)
                rows += [{"command": name, **row} for row in found]
                keep(self.title, rows, self.out)
        report(self.title, rows, self.out)


@dataclasses.dataclass(frozen=True)
class Scans(Part):
    """Describe very many small scans in one go: seconds, and resident memory on the way."""

    count: int = 100_000
    points: int = 200
    """Of each scan."""
    method: str = "solid"
    """A handcrafted method that takes points, or `network`: one of next to no arithmetic, with weights as drawn."""
    moments: int = 10
    """Rows of the table."""

    def run(self) -> None:
        count, seconds = 500 if self.quick else self.count, {}
        with tempfile.TemporaryDirectory() as name:
            scans, path = Path(name) / "scans", Path(name) / "all.npz"
            _, seconds["write them"] = _timed(lambda: write_scans(scans, count=count, points=self.points))
            recording, seconds["open"] = _timed(lambda: sglpr_jax.open_recording(scans))
            method = tiny_network() if self.method == "network" else method_named(self.method, None, recording)
            watch = Watch(count, self.moments)
            file, seconds["embed"] = _timed(lambda: sglpr_jax.embed(method, recording, on_progress=watch))
            _, seconds["save"] = _timed(lambda: file.save(path))
            again, seconds["load"] = _timed(lambda: sglpr_jax.DescriptorFile.load(path))
            assert len(again) == count
        parts = ", ".join(f"{value:.1f} s to {name}" for name, value in seconds.items())
        each = file.descriptors.nbytes / count / 1e6
        rows = [{**row, "MB of descriptors": row["scans"] * each} for row in watch.rows]
        report(f"{count} scans of {self.points} points, {self.method}: {parts}", rows, self.out)


@dataclasses.dataclass(frozen=True)
class Kills(OfCommands):
    """Kill each command with signal 9 again and again; see what lies there, and how its next run ends."""

    title = "killed"

    def rows(self, writer: Writer, folder: Path, times: int) -> Iterator[Row]:
        whole, counts = killed(writer, folder, kills=times, seed=self.seed)
        yield {"seconds": whole.seconds, "files": len(whole.files), **counts}


@dataclasses.dataclass(frozen=True)
class Together(OfCommands):
    """Start each command twice at once on one folder."""

    times: int = 5
    title = "two at once"

    def rows(self, writer: Writer, folder: Path, times: int) -> Iterator[Row]:
        yield dict(together(writer, folder, times=times))


@dataclasses.dataclass(frozen=True)
class Disk(OfCommands):
    """No room, no right to write, files that are read vanish or are half there: one line, and nothing half-written."""

    times: int = 4
    title = "troubles"

    def rows(self, writer: Writer, folder: Path, times: int) -> Iterator[Row]:
        for trouble, counts in troubled(writer, folder, times=1 if self.quick else times, seed=self.seed).items():
            yield {"trouble": trouble, **counts}


def report(title: str, rows: Sequence[Row], out: Path | None) -> None:
    """Print a table, whose columns are the keys of its rows, and how it was made; keep it where a file is named."""
    table = Table(*rows[0], title=title)
    for row in rows:
        table.add_row(*(f"{value:.1f}" if isinstance(value, float) else str(value) for value in row.values()))
    Console(width=None if sys.stdout.isatty() else 140).print(table)
    print(f"Command: {_command()}\n{os.cpu_count()} CPUs, load average {os.getloadavg()[0]:.1f}")
    keep(title, rows, out)


def keep(title: str, rows: Sequence[Row], out: Path | None) -> None:
    """Write what there is of a table, where a file is named: hours of it may end early."""
    if out is not None:
        write_json(out, {"title": title, "command": _command(), "rows": rows})


def _command() -> str:
    return shlex.join(["python", *sys.argv])


def _timed(job: Callable[[], T]) -> tuple[T, float]:
    start = time.perf_counter()
    value = job()
    return value, time.perf_counter() - start


if __name__ == "__main__":
    tyro.cli(
        Annotated[Scans, tyro.conf.subcommand("scans")]
        | Annotated[Kills, tyro.conf.subcommand("kills")]
        | Annotated[Together, tyro.conf.subcommand("together")]
        | Annotated[Disk, tyro.conf.subcommand("disk")]
    ).run()
