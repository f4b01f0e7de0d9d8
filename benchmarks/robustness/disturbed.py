"""Tests of commands that write files: killed, started twice at once, on a full disk, without rights, with bad input.

Inputs are small, so that a command takes a second. A command runs in a process that is forked from this one, which has
imported the command's module but not started JAX. The command therefore starts quickly, and a kill hits its work.
"""

import contextlib
import ctypes
import dataclasses
import fnmatch
import functools
import importlib
import itertools
import multiprocessing
import os
import random
import resource
import shutil
import struct
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.context import ForkProcess as Process
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.table import Table
from benchmarks.timing import about
from sglpr_jax.files import half_written

INPUTS, OUT, ERRORS = "inputs", "out", "stderr"
"""Folder of the input files, and output folder and file for stderr within the folder of a command."""
TIMEOUT_S = 900
DRIVE = "--azimuth-steps 60 --sensor vlp16"
TOWN = f"../{INPUTS}/town"
SCANS = f"{TOWN}/sequences/08/velodyne"
POSES = f"--poses {TOWN}/sequences/%s/poses.txt --pose-format kitti"
TRAINED = f"--seq 08 --data {TOWN} --preset tiny --steps 8 --method solid"
RUN_FILES = ("*/checkpoints/*", "*/environment.json", "*/metrics.jsonl", "*/learning-curves.png", "*/mining/*")


@dataclasses.dataclass(frozen=True)
class Writer:
    """A command that writes into `OUT`."""

    line: str
    """Arguments."""
    varies: tuple[str, ...] = ()
    """Patterns of files below `OUT` that may differ between runs, for example because they contain times."""
    resumed_by: str = ""
    """File below `OUT`. If it exists, the command is started with --resume."""
    refuses: str = ""
    """Part of the error of a command that refuses to run again after it has finished. Empty: it can run again."""


WRITERS = {
    "embed": Writer(f"--weights sglpr-small --data {TOWN} --seq 08 --out {OUT}/08.npz"),
    "evaluate": Writer(f"../{INPUTS}/08.npz --data {TOWN} --seq 08 --out {OUT}/08"),
    "simulate": Writer(f"--out {OUT}/town {DRIVE} --seq 08 --scans 12"),
    "simulate images": Writer(f"--out {OUT}/town {DRIVE} --seq 08 --scans 12 --images"),
    "export": Writer(f"--weights sglpr-small --out {OUT}/mine", refuses="not exist yet"),
    "export stablehlo": Writer(f"--weights sglpr-small --format stablehlo --out {OUT}/mine", refuses="not exist yet"),
    "map": Writer(f"{TOWN} --seq 08 {POSES % '08'} --out {OUT}/town.safetensors", varies=("town.unfinished/*",)),
    "map more": Writer(
        f"{TOWN} --seq 05 {POSES % '05'} --add-to ../{INPUTS}/town.safetensors --out {OUT}/town.safetensors",
        varies=("town.unfinished/*",),
    ),
    "relocalize": Writer(f"{SCANS}/000003.bin --map ../{INPUTS}/town.safetensors --out {OUT}/pose.json"),
    "loops": Writer(
        f"{TOWN} --seq 08 --odometry {TOWN}/sequences/08/poses.txt --odometry-format kitti --out {OUT}/found",
        varies=("found/unfinished/*",),
    ),
    "segment": Writer(f"--weights sglpr --data {TOWN} --seq 08 --out {OUT}/maps"),
    "train": Writer(f"{TRAINED} --out {OUT}/run --cache {OUT}/packs", varies=RUN_FILES, resumed_by="run/config.json"),
    "reproduce": Writer(f"table1 {TRAINED} --out {OUT}/paper", varies=RUN_FILES),
}
"""Commands by name. The first word is the command in `bin/`."""
INPUT_LINES = (
    f"simulate --out town {DRIVE} --seq 05 08 --scans 24 --rate-hz 1",
    "embed --method solid --data town --seq 08 --out 08.npz",
    "map town --seq 08 --poses town/sequences/08/poses.txt --pose-format kitti --out town.safetensors",
)


def start(
    command: str,
    arguments: Sequence[str],
    folder: Path,
    *,
    errors: str = ERRORS,
    file_bytes: int | None = None,
    unprivileged: bool = False,
) -> Process:
    """Starts a command in a folder. Its stderr goes to the file `errors` there.

    Files are limited to `file_bytes`. An `unprivileged` process respects file permissions even if its user is root.
    """
    cache = folder.parent / "cache"
    os.environ |= {
        "XDG_CACHE_HOME": str(cache),
        "JAX_PLATFORMS": "cpu",
        "JAX_COMPILATION_CACHE_DIR": str(cache / "xla"),
    }
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.1"
    cli = importlib.import_module("sglpr_jax.cli.__main__")
    cli.load_command(command)  # imported once, for all processes

    def work() -> None:
        os.chdir(folder)
        sys.argv = ["sglpr_jax.cli", command, *arguments]
        for stream, path in ((1, os.devnull), (2, errors)):
            os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), stream)
        if file_bytes is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (file_bytes, file_bytes))
        if unprivileged:  # drops all capabilities, see capset(2)
            assert ctypes.CDLL(None).capset(struct.pack("Ii", 0x20080522, 0), bytes(24)) == 0
        cli.main()

    process = multiprocessing.get_context("fork").Process(target=work)
    process.start()
    return process


def status_of(process: Process) -> int:
    """Waits for a process and returns its exit status, which is negative if a signal ended the process."""
    process.join(TIMEOUT_S)
    assert process.exitcode is not None, f"it has not ended after {TIMEOUT_S} s"
    return process.exitcode


class Undisturbed(NamedTuple):
    """Result of an undisturbed run."""

    files: dict[str, bytes]  # contents of the written files, by path
    seconds: float
    changes: int  # number of changes in the output folder


class Trial:
    """Command in an empty folder. The folder of a command is always the same, because some files contain its path."""

    def __init__(self, name: str, root: Path):
        self.name, self.writer, self.folder = name, WRITERS[name], root / name.replace(" ", "-")
        shutil.rmtree(self.folder, ignore_errors=True)
        self.out = self.folder / OUT
        self.out.mkdir(parents=True)

    def start(self, **options: Any) -> Process:
        """Starts the command, or continues it. The options are those of the function `start`."""
        resume = self.writer.resumed_by and (self.out / self.writer.resumed_by).exists()
        arguments = [*self.writer.line.split(), *["--resume"] * bool(resume)]
        return start(self.name.split()[0], arguments, self.folder, **options)

    def run(self, **options: Any) -> int:
        """Run the command to its end, and return the exit status."""
        return status_of(self.start(**options))

    def error(self, errors: str = ERRORS) -> str:
        """Text that the command printed to stderr."""
        path = self.folder / errors
        return path.read_text() if path.exists() else ""

    def files(self) -> dict[str, bytes]:
        """Files under their final names below `OUT`, by path."""
        paths = [path for path in sorted(self.out.rglob("*")) if path.is_file()]
        return {
            name: (self.out / name).read_bytes()
            for name in (str(path.relative_to(self.out)) for path in paths)
            if not any(part.startswith(".") for part in Path(name).parts)
        }

    def changes(self, process: Process) -> Iterator[None]:
        """Yields at each change in the output folder while the process runs. Polls 1000 times a second."""
        previous_sizes: list[tuple[str, int]] = []
        while process.is_alive():
            if (sizes := _sizes(self.out)) != previous_sizes:
                previous_sizes = sizes
                yield
            time.sleep(1e-3)

    def count_differing(self, undisturbed: dict[str, bytes], what: str, *, complete: bool = False) -> int:
        """Prints and counts the files that differ from an undisturbed run, except those in `Writer.varies`.

        With `complete`, missing files count too.
        """
        files = self.files()
        names = {**files, **undisturbed} if complete else files
        differing = [name for name in names if files.get(name) != undisturbed.get(name)]
        wrong = [name for name in differing if not any(fnmatch.fnmatch(name, one) for one in self.writer.varies)]
        for name in wrong:
            print(f"{self.name}: {name} {what}", file=sys.stderr)
        return len(wrong)


def _sizes(folder: Path) -> list[tuple[str, int]]:
    """Paths with sizes of all files, also hidden ones, and of all folders, whose size is -1."""
    sizes = []
    for parent, folders, files in os.walk(folder):
        sizes += [(os.path.join(parent, name), -1) for name in folders]
        for path in (os.path.join(parent, name) for name in files):
            with contextlib.suppress(FileNotFoundError):
                sizes.append((path, os.stat(path).st_size))
    return sorted(sizes)


def _undisturbed(name: str, root: Path) -> Undisturbed:
    """Runs a command twice, and returns the second run. The first run compiles. Both must write the same bytes."""
    runs = []
    for _ in range(2):
        trial, begin = Trial(name, root), time.perf_counter()
        process = trial.start()
        changes = sum(1 for _ in trial.changes(process))
        assert status_of(process) == 0, f"{name}: {trial.error()}"
        runs.append(Undisturbed(trial.files(), time.perf_counter() - begin, changes))
    assert runs[1].files and not trial.count_differing(runs[0].files, "differs between two runs")
    return runs[1]


def _disturb(commands: Sequence[str], rows_of: Callable[[str, Path, Undisturbed], Iterator[dict[str, Any]]]) -> None:
    """Makes the inputs, and prints the rows that `rows_of` yields for each command."""
    table = None
    with tempfile.TemporaryDirectory() as folder:
        inputs = Path(folder) / INPUTS
        inputs.mkdir()
        for line in INPUT_LINES:
            command, *arguments = line.split()
            assert status_of(start(command, arguments, inputs)) == 0, (inputs / ERRORS).read_text()
        (inputs / ERRORS).unlink()
        for name in commands:
            for row in rows_of(name, Path(folder), _undisturbed(name, Path(folder))):
                table = table or Table("command", *row)
                table.add(name, *row.values())
    print("\n".join(about().values()))


def kills(*, commands: tuple[str, ...] = tuple(WRITERS), times: int = 20, seed: int = 0) -> None:
    """Kill each command with signal 9 again and again; see what lies there, and how its next run ends.

    Every second kill comes at any time of the run, the others within 5 ms of a change in its folder. Counts kills,
    those in the middle of writing, files that are half there under their own names, next runs that fail, and other
    bytes.

    Args:
        commands: names in `WRITERS`.
        times: how often each is killed.
        seed: seed of the moments.
    """
    _disturb(commands, functools.partial(_killed, times=times, seed=seed))


def _killed(name: str, root: Path, undisturbed: Undisturbed, *, times: int, seed: int) -> Iterator[dict[str, Any]]:
    """Kill a command this many times, each time in an empty folder, and run it again."""
    draw = random.Random(f"{seed} {name}")
    counts = dict.fromkeys(("kills", "in the middle", "half-written", "next run fails", "other bytes"), 0)
    for attempt in range(3 * times):
        if counts["kills"] == times:
            break
        trial = Trial(name, root)
        process = trial.start()
        if attempt % 2:
            for _ in itertools.islice(trial.changes(process), draw.randint(1, undisturbed.changes)):
                pass
            time.sleep(draw.uniform(0, 5e-3))
        else:
            time.sleep(draw.uniform(0, undisturbed.seconds))
        process.kill()
        if status_of(process) >= 0:
            continue  # the command had finished before
        counts["kills"] += 1
        counts["in the middle"] += bool(half_written(trial.out)) or 0 < len(trial.files()) < len(undisturbed.files)
        counts["half-written"] += trial.count_differing(undisturbed.files, "is not whole")
        status, refusal = trial.run(), trial.writer.refuses
        if status == 0 or (refusal and refusal in trial.error()):
            counts["other bytes"] += trial.count_differing(
                undisturbed.files, "differs after the next run", complete=True
            )
        else:
            counts["next run fails"] += 1
            print(f"{name}: the next run ended with {status}: {trial.error()[-2000:]}", file=sys.stderr)
    yield {"seconds": f"{undisturbed.seconds:.1f}", "files": len(undisturbed.files), **counts}


def together(*, commands: tuple[str, ...] = tuple(WRITERS), times: int = 5) -> None:
    """Start each command twice at once on one folder: both end well, or one is refused in one line.

    Args:
        commands: names in `WRITERS`.
        times: how often each is started twice.
    """
    _disturb(commands, functools.partial(_doubled, times=times))


def _doubled(name: str, root: Path, undisturbed: Undisturbed, *, times: int) -> Iterator[dict[str, Any]]:
    """Start a command twice at once, this many times."""
    counts = dict.fromkeys(("both end well", "one is refused", "fail", "other bytes"), 0)
    for _ in range(times):
        trial, errors = Trial(name, root), (f"{ERRORS}-0", f"{ERRORS}-1")
        statuses = [status_of(process) for process in [trial.start(errors=one) for one in errors]]
        failures = [trial.error(one) for one, status in zip(errors, statuses, strict=True) if status]
        refused = len(failures) == 1 and _is_one_line(failures[0])
        counts["both end well" if not failures else "one is refused" if refused else "fail"] += 1
        for error in failures:
            print(f"{name}: one of two ended with: {error[-2000:]}", file=sys.stderr)
        counts["other bytes"] += trial.count_differing(undisturbed.files, "differs after two at once", complete=True)
    yield counts


def disk(*, commands: tuple[str, ...] = tuple(WRITERS), times: int = 4, seed: int = 0) -> None:
    """No room, no right to write, files that are read vanish or are half there: one line, and nothing half-written.

    Args:
        commands: names in `WRITERS`.
        times: how often each trouble is made.
        seed: seed of sizes and moments.
    """
    _disturb(commands, functools.partial(_troubled, times=times, seed=seed))


def _troubled(name: str, root: Path, undisturbed: Undisturbed, *, times: int, seed: int) -> Iterator[dict[str, Any]]:
    """Run a command with each of `TROUBLES`, this many times."""
    draw = random.Random(f"{seed} {name}")
    for trouble, run in TROUBLES.items():
        counts = dict.fromkeys(("refused in one line", "ends well", "anything else", "half-written"), 0)
        for _ in range(times):
            trial = Trial(name, root)
            status = run(trial, undisturbed, draw)
            refused = status == 1 and _is_one_line(trial.error())
            kind = "ends well" if status == 0 else "refused in one line" if refused else "anything else"
            if kind == "anything else":
                print(f"{name}, {trouble}: status {status}: {trial.error()[-2000:]}", file=sys.stderr)
            counts[kind] += 1
            counts["half-written"] += trial.count_differing(undisturbed.files, f"is not whole: {trouble}")
        yield {"trouble": trouble, **counts}


def _is_one_line(error: str) -> bool:
    """Whether stderr ends with one line "error: ...", without a traceback."""
    return "Traceback" not in error and error.rstrip("\n").split("\n")[-1].startswith("error: ")


def _without_room(trial: Trial, undisturbed: Undisturbed, draw: random.Random) -> int:
    """Runs a command with limited file sizes, which fails like a full disk. The limit is below the largest file."""
    return trial.run(file_bytes=draw.randrange(max(map(len, undisturbed.files.values()))))


def _without_rights(trial: Trial, undisturbed: Undisturbed, draw: random.Random) -> int:
    """Runs a command whose output folder is read-only."""
    trial.out.chmod(0o555)
    status = trial.run(unprivileged=True)
    trial.out.chmod(0o755)
    return status


def _meanwhile(trial: Trial, undisturbed: Undisturbed, draw: random.Random, change: Callable[[Path], None]) -> int:
    """Changes an input file of the command, or a scan of its input recording, at a random time of its run."""
    root = trial.folder.parent
    inputs, before = root / INPUTS, root / "inputs-before"
    shutil.copytree(inputs, before)
    try:
        scans = sorted((trial.folder / SCANS).iterdir())
        named = [trial.folder / word for word in trial.writer.line.split() if word.startswith(f"../{INPUTS}/")]
        process = trial.start()
        time.sleep(draw.uniform(0, undisturbed.seconds))
        change(draw.choice([*scans[-len(named) :], *(one for one in named if one.is_file())]))
        return status_of(process)
    finally:
        shutil.rmtree(inputs)
        before.rename(inputs)


def _cut(path: Path) -> None:
    """Truncates a file to an odd size near its middle, so that it ends within a number."""
    os.truncate(path, path.stat().st_size // 2 | 1)


TROUBLES: dict[str, Callable[[Trial, Undisturbed, random.Random], int]] = {
    "full disk": _without_room,
    "read-only folder": _without_rights,
    "a file vanishes": functools.partial(_meanwhile, change=Path.unlink),
    "a file is half there": functools.partial(_meanwhile, change=_cut),
}
