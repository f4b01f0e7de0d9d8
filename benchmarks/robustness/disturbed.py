"""Tests of commands that write files: killed, and with troubles of disk and input.

Inputs are small, so that a command takes a second. A command runs in a process that is forked from this one, which has
imported the command's module but not started JAX. The command therefore starts quickly, and a kill hits its work.

Small file systems are mounted in a mount namespace of this process, which ends with it. This needs root.
"""

import contextlib
import ctypes
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
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.context import ForkProcess as Process
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.robustness.writers import BAG, INPUT_LINES, INPUTS, OUT, SCANS, WRITERS, write_bag_of
from benchmarks.table import Table
from benchmarks.timing import about
from sglpr_jax.files import half_written

ERRORS = "stderr"
"""File for stderr in the folder of a command."""
TIMEOUT_S = 900
PAGE = 4096
"""Bytes of the smallest part of a file system in memory."""
CLONE_NEWNS = 0x20000
"""Flag of unshare(2) for mounts of its own."""


def start(
    command: str,
    arguments: Sequence[str],
    folder: Path,
    *,
    file_bytes: int | None = None,
    unprivileged: bool = False,
) -> Process:
    """Starts a command in a folder. Its stderr goes to the file `ERRORS` there.

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
        for stream, path in ((1, os.devnull), (2, ERRORS)):
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

    def error(self) -> str:
        """Text that the command printed to stderr."""
        path = self.folder / ERRORS
        return path.read_text() if path.exists() else ""

    def files(self) -> dict[str, bytes]:
        """Files under their final names below `OUT`, by path."""
        paths = [path for path in sorted(self.out.rglob("*")) if path.is_file()]
        return {
            name: (self.out / name).read_bytes()
            for name in (str(path.relative_to(self.out)) for path in paths)
            if not any(part.startswith(".") for part in Path(name).parts)
        }

    def keep_files(self) -> None:
        """Unmounts the file system at the output folder, whose files stay."""
        kept = self.folder / "kept"
        shutil.copytree(self.out, kept)
        subprocess.run(("umount", self.out), check=True)
        self.out.rmdir()
        kept.rename(self.out)

    def changes(self, process: Process) -> Iterator[None]:
        """Yields at each change in the output folder while the process runs. Polls 1000 times a second."""
        previous_sizes: list[tuple[str, int]] = []
        while process.is_alive():
            if (sizes := _sizes(self.out)) != previous_sizes:
                previous_sizes = sizes
                yield
            time.sleep(1e-3)

    def wait(self, process: Process, undisturbed: Undisturbed, draw: random.Random, *, near_change: bool) -> None:
        """Wait for a random moment of the run, or for one within 5 ms of a change in the output folder."""
        if near_change:
            for _ in itertools.islice(self.changes(process), draw.randint(1, undisturbed.changes)):
                pass
            time.sleep(draw.uniform(0, 5e-3))
        else:
            time.sleep(draw.uniform(0, undisturbed.seconds))

    def count_differing(self, undisturbed: dict[str, bytes], what: str, *, complete: bool = False) -> int:
        """Prints and counts the files that differ from an undisturbed run, except those in `Writer.varies`.

        With `complete`, missing files and missing last lines of `Writer.grows` count too.
        """
        files = self.files()
        names = {**files, **undisturbed} if complete else files
        differing = [name for name in names if files.get(name) != undisturbed.get(name)]
        allowed = [name for name in differing if _matches(name, self.writer.varies)]
        if not complete:
            growing = [name for name in differing if _matches(name, self.writer.grows)]
            allowed += [name for name in growing if undisturbed[name].startswith(files[name])]
        wrong = [name for name in differing if name not in allowed]
        for name in wrong:
            print(f"{self.name}: {name} {what}", file=sys.stderr)
        return len(wrong)


def _matches(name: str, patterns: Sequence[str]) -> bool:
    """Whether a path matches one of some patterns."""
    return any(fnmatch.fnmatch(name, pattern) for pattern in patterns)


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
        write_bag_of(inputs / "town", inputs / BAG)
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
        trial.wait(process, undisturbed, draw, near_change=bool(attempt % 2))
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


def _is_one_line(error: str, *, named: str = "") -> bool:
    """Whether stderr ends with one line "error: ..." that names a path with this part, without a traceback."""
    last = error.rstrip("\n").split("\n")[-1]
    return "Traceback" not in error and last.startswith("error: ") and named in last


def _without_room(trial: Trial, undisturbed: Undisturbed, draw: random.Random) -> int:
    """Runs a command with limited file sizes, which fails like a full disk. The limit is below the largest file."""
    return trial.run(file_bytes=draw.randrange(max(map(len, undisturbed.files.values()))))


def _without_rights(trial: Trial, undisturbed: Undisturbed, draw: random.Random) -> int:
    """Runs a command whose output folder is read-only."""
    trial.out.chmod(0o555)
    status = trial.run(unprivileged=True)
    trial.out.chmod(0o755)
    return status


def _on_small_disk(trial: Trial, undisturbed: Undisturbed, draw: random.Random) -> int:
    """Runs a command whose output folder has less room than its files need, because another file takes some."""
    pages = sum(-(-len(content) // PAGE) for content in undisturbed.files.values())
    return _mounted(trial, f"size={PAGE * pages}", taken=PAGE * draw.randint(1, pages))


def _on_few_inodes(trial: Trial, undisturbed: Undisturbed, draw: random.Random) -> int:
    """Runs a command whose output folder takes fewer files and folders than it writes."""
    written = {part for name in undisturbed.files for part in (Path(name), *Path(name).parents)}
    return _mounted(trial, f"nr_inodes={draw.randint(1, len(written) - 1)}")


def _mounted(trial: Trial, options: str, *, taken: int = 0) -> int:
    """Runs a command whose output folder is a file system in memory, with a hidden file of `taken` bytes."""
    subprocess.run(("mount", "-t", "tmpfs", "-o", options, "tmpfs", trial.out), check=True)
    if taken:
        (trial.out / ".taken").write_bytes(bytes(taken))
    status = trial.run()
    trial.keep_files()
    return status


def _without_folder(trial: Trial, undisturbed: Undisturbed, draw: random.Random) -> int:
    """Runs a command whose output folder is removed at a random moment, mostly near a change in it.

    If everything had been written before, the folder comes back.
    """
    process = trial.start()
    trial.wait(process, undisturbed, draw, near_change=draw.random() < 0.75)
    removed, copied = trial.folder / "removed", trial.folder / "copied"
    with contextlib.suppress(FileNotFoundError):  # the command has removed the folder
        trial.out.rename(removed)  # at once, because the command goes on
        shutil.copytree(removed, copied)
        shutil.rmtree(removed)
    status = status_of(process)
    if status == 0 and copied.exists() and not trial.files():
        shutil.copytree(copied, trial.out, dirs_exist_ok=True)
    return status


def _meanwhile(trial: Trial, undisturbed: Undisturbed, draw: random.Random, change: Callable[[Path], None]) -> int:
    """Changes an input file of the command, or a scan of its input recording, at a random time of its run."""
    root = trial.folder.parent
    inputs, before = root / INPUTS, root / "inputs-before"
    shutil.copytree(inputs, before)
    try:
        scans = sorted((trial.folder / SCANS).iterdir())
        words = [word.removeprefix("bag:") for word in trial.writer.line.split()]
        named = [trial.folder / word for word in words if word.startswith(f"../{INPUTS}/")]
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


class Trouble(NamedTuple):
    """A trouble of a command."""

    run: Callable[[Trial, Undisturbed, random.Random], int]
    """Runs the command with the trouble, and returns its exit status."""
    of_output: bool = True
    """Whether the output is disturbed, not the input."""
    is_mounted: bool = False
    """Whether a file system is mounted, which needs root."""


TROUBLES = {
    "full disk": Trouble(_without_room),
    "no space left": Trouble(_on_small_disk, is_mounted=True),
    "no more files": Trouble(_on_few_inodes, is_mounted=True),
    "read-only folder": Trouble(_without_rights),
    "the folder vanishes": Trouble(_without_folder),
    "a file vanishes": Trouble(functools.partial(_meanwhile, change=Path.unlink), of_output=False),
    "a file is half there": Trouble(functools.partial(_meanwhile, change=_cut), of_output=False),
}


def disk(
    *,
    commands: tuple[str, ...] = tuple(WRITERS),
    troubles: tuple[str, ...] = tuple(TROUBLES),
    times: int = 4,
    seed: int = 0,
) -> None:
    """No room, no right to write, files or folders vanish, input is half there: one line, and nothing half-written.

    Args:
        commands: names in `WRITERS`.
        troubles: names in `TROUBLES`. Those that mount a small file system need root.
        times: how often each trouble is made.
        seed: seed of sizes and moments.
    """
    if mounted := [name for name in troubles if TROUBLES[name].is_mounted]:
        _mount_privately(mounted)
    _disturb(commands, functools.partial(_troubled, troubles=troubles, times=times, seed=seed))


def _mount_privately(names: Sequence[str]) -> None:
    """Give this process mounts of its own, which end with it."""
    if ctypes.CDLL(None).unshare(CLONE_NEWNS):
        raise SystemExit(f"error: {', '.join(names)}: expected root, which may mount; choose other --troubles")
    subprocess.run(("mount", "--make-rprivate", "/"), check=True)


def _troubled(
    name: str, root: Path, undisturbed: Undisturbed, *, troubles: Sequence[str], times: int, seed: int
) -> Iterator[dict[str, Any]]:
    """Run a command with each trouble, this many times. If it ends well, all its files must be there."""
    for trouble in troubles:
        draw = random.Random(f"{seed} {name} {trouble}")
        counts = dict.fromkeys(("refused in one line", "ends well", "anything else", "half-written"), 0)
        for _ in range(times):
            trial = Trial(name, root)
            status = TROUBLES[trouble].run(trial, undisturbed, draw)
            place = OUT if TROUBLES[trouble].of_output else INPUTS
            refused = status == 1 and _is_one_line(trial.error(), named=f"{place}/")
            kind = "ends well" if status == 0 else "refused in one line" if refused else "anything else"
            if kind == "anything else":
                print(f"{name}, {trouble}: status {status}: {trial.error()[-2000:]}", file=sys.stderr)
            counts[kind] += 1
            if TROUBLES[trouble].of_output or status:  # otherwise it may be the result of fewer scans
                what = f"is not whole: {trouble}, status {status}"
                counts["half-written"] += trial.count_differing(undisturbed.files, what, complete=status == 0)
        yield {"trouble": trouble, **counts}
