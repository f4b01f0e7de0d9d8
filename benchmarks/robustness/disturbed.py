"""Commands that write files, disturbed: killed, run twice at once, without room or rights, their input changed."""

import contextlib
import functools
import itertools
import os
import random
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console
from rich.table import Table

from benchmarks.robustness.writers import (
    ERRORS,
    INPUTS,
    OUT,
    WRITERS,
    Process,
    Writer,
    ended,
    make_inputs,
    said,
    written,
)
from benchmarks.timing import about
from sglpr_jax.files import half_written

Row = dict[str, Any]
"""Titles of columns and their values."""


def kills(*, commands: tuple[str, ...] = tuple(WRITERS), times: int = 20, seed: int = 0) -> None:
    """Kill each command with signal 9 again and again; see what lies there, and how its next run ends.

    Every second kill comes at any time of the run, the others within 5 ms of a change in its folder. Counts kills,
    those in the middle of writing, files that are half there under their own names, next runs that fail, and other
    bytes.

    Args:
        commands: names in `writers.WRITERS`.
        times: how often each is killed.
        seed: seed of the moments.
    """
    _run("killed", commands, functools.partial(_killed, times=times, seed=seed))


def together(*, commands: tuple[str, ...] = tuple(WRITERS), times: int = 5) -> None:
    """Start each command twice at once on one folder: both end well, or one is refused in one line.

    Args:
        commands: names in `writers.WRITERS`.
        times: how often each is started twice.
    """
    _run("two at once", commands, functools.partial(_together, times=times))


def disk(*, commands: tuple[str, ...] = tuple(WRITERS), times: int = 4, seed: int = 0) -> None:
    """No room, no right to write, files that are read vanish or are half there: one line, and nothing half-written.

    Args:
        commands: names in `writers.WRITERS`.
        times: how often each trouble is made.
        seed: seed of sizes and moments.
    """
    _run("troubles", commands, functools.partial(_troubled, times=times, seed=seed))


def _run(title: str, commands: Sequence[str], rows_of: Callable[[Writer, Path], Iterator[Row]]) -> None:
    """Disturb commands. Prints a row as soon as it is known, and a table."""
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as folder:
        make_inputs(Path(folder))
        for name in commands:
            for row in rows_of(WRITERS[name], Path(folder)):
                rows.append({"command": name, **row})
                print(rows[-1], flush=True)
    table = Table(*rows[0], title=title)
    for row in rows:
        table.add_row(*(f"{value:.1f}" if isinstance(value, float) else str(value) for value in row.values()))
    Console(width=140).print(table)
    print("\n".join(about().values()))


class Whole(NamedTuple):
    """An undisturbed run."""

    files: dict[str, bytes]
    seconds: float
    changes: int
    """How often something changed in its folder."""


def _undisturbed(writer: Writer, folder: Path) -> Whole:
    """Run twice: the first run compiles, and the second has to end with the same bytes."""
    runs = []
    for _ in range(2):
        place, start = _fresh(folder, writer), time.perf_counter()
        process = writer.begin(place)
        changes = sum(1 for _ in _changing(process, place))
        assert ended(process) == 0, f"{writer.name}: {said(place)}"
        runs.append(Whole(written(place), time.perf_counter() - start, changes))
    unlike = writer.differing(runs[1].files, runs[0].files)
    assert not unlike and runs[1].files, f"{writer.name}: two runs differ in {', '.join(unlike)}"
    return runs[1]


def _changing(process: Process, folder: Path) -> Iterator[None]:
    """Yield each time that something has changed in what a process writes, until it ends; looks 1000 times a second."""
    before: list[tuple[str, int]] = []
    while process.is_alive():
        if (now := _seen(folder / OUT)) != before:
            before = now
            yield
        time.sleep(1e-3)


def _seen(folder: Path) -> list[tuple[str, int]]:
    """Files, those with hidden names too, and their sizes; folders."""
    found = []
    for where, folders, files in os.walk(folder):
        found += [(os.path.join(where, name), -1) for name in folders]
        for path in (os.path.join(where, name) for name in files):
            with contextlib.suppress(FileNotFoundError):
                found.append((path, os.stat(path).st_size))
    return sorted(found)


def _killed(writer: Writer, folder: Path, *, times: int, seed: int) -> Iterator[Row]:
    """Kill a command so often, each time in a fresh folder, and let it run again."""
    draw, whole = random.Random(f"{seed} {writer.name}"), _undisturbed(writer, folder)
    counts = dict.fromkeys(("kills", "in the middle", "half-written", "next run fails", "other bytes"), 0)
    for attempt in range(3 * times):
        if counts["kills"] == times:
            break
        place = _fresh(folder, writer)
        process = writer.begin(place)
        if attempt % 2:
            for _ in itertools.islice(_changing(process, place), draw.randint(1, whole.changes)):
                pass
            time.sleep(draw.uniform(0, 5e-3))
        else:
            time.sleep(draw.uniform(0, whole.seconds))
        process.kill()
        if ended(process) >= 0:
            continue  # it was faster
        found = written(place)
        counts["kills"] += 1
        counts["in the middle"] += bool(half_written(place / OUT)) or 0 < len(found) < len(whole.files)
        counts["half-written"] += _told(writer, "is not whole", writer.differing(found, whole.files))
        if not _finishes(writer, place):
            counts["next run fails"] += 1
        else:
            unlike = writer.differing(written(place), whole.files, complete=True)
            counts["other bytes"] += _told(writer, "is another one after the next run", unlike)
    yield {"seconds": whole.seconds, "files": len(whole.files), **counts}


def _together(writer: Writer, folder: Path, *, times: int) -> Iterator[Row]:
    """Start a command twice at once, so often."""
    whole = _undisturbed(writer, folder)
    counts = dict.fromkeys(("both end well", "one is refused", "fail", "other bytes"), 0)
    for _ in range(times):
        place = _fresh(folder, writer)
        errors = (f"{ERRORS}-0", f"{ERRORS}-1")
        processes = [writer.begin(place, errors=name) for name in errors]
        statuses = [ended(process) for process in processes]
        bad = [said(place, name) for name, status in zip(errors, statuses, strict=True) if status]
        refused = len(bad) == 1 and _is_one_line(bad[0])
        counts["both end well" if not bad else "one is refused" if refused else "fail"] += 1
        for error in bad:
            print(f"{writer.name}: one of two ended with: {error[-2000:]}", file=sys.stderr)
        unlike = writer.differing(written(place), whole.files, complete=True)
        counts["other bytes"] += _told(writer, "is another one after two at once", unlike)
    yield dict(counts)


def _troubled(writer: Writer, folder: Path, *, times: int, seed: int) -> Iterator[Row]:
    """Let a command run with each of `TROUBLES`, so often."""
    draw, whole = random.Random(f"{seed} {writer.name}"), _undisturbed(writer, folder)
    for name, trouble in TROUBLES.items():
        counts = dict.fromkeys(("refused in one line", "ends well", "anything else", "half-written"), 0)
        for _ in range(times):
            place = _fresh(folder, writer)
            status = trouble(writer, place, whole, draw)
            refused = status == 1 and _is_one_line(said(place))
            kind = "ends well" if status == 0 else "refused in one line" if refused else "anything else"
            if kind == "anything else":
                print(f"{writer.name}, {name}: status {status}: {said(place)[-2000:]}", file=sys.stderr)
            counts[kind] += 1
            unlike = writer.differing(written(place), whole.files)
            counts["half-written"] += _told(writer, f"is not whole: {name}", unlike)
        yield {"trouble": name, **counts}


def _is_one_line(error: str) -> bool:
    """Whether a command ended as it should if something is wrong."""
    return "Traceback" not in error and error.rstrip("\n").split("\n")[-1].startswith("error: ")


def _full(writer: Writer, place: Path, whole: Whole, draw: random.Random) -> int:
    """No file may grow beyond a part of the largest one: to a program that is a full disk, and it takes no rights."""
    largest = max(len(content) for content in whole.files.values())
    return ended(writer.begin(place, file_bytes=draw.randrange(largest)))


def _read_only(writer: Writer, place: Path, whole: Whole, draw: random.Random) -> int:
    """Nobody may write into the folder."""
    (place / OUT).mkdir(parents=True)
    (place / OUT).chmod(0o555)
    status = ended(writer.begin(place, humble=True))
    (place / OUT).chmod(0o755)
    return status


def _meanwhile(writer: Writer, place: Path, whole: Whole, draw: random.Random, change: Callable[[Path], None]) -> int:
    """Change a file that the command names, or a scan of the drive that it names, at any time of its run."""
    inputs, before = place.parent / INPUTS, place.parent / "inputs-before"
    shutil.copytree(inputs, before)
    try:
        scans = sorted((inputs / "town/sequences/08/velodyne").iterdir())
        named = [place / word for word in writer.line.split() if word.startswith(f"../{INPUTS}/")]
        process = writer.begin(place)
        time.sleep(draw.uniform(0, whole.seconds))
        change(draw.choice([*scans[-len(named) :], *(one for one in named if one.is_file())]))
        return ended(process)
    finally:
        shutil.rmtree(inputs)
        before.rename(inputs)


def _half(path: Path) -> None:
    """Cut a file in the middle of a number."""
    os.truncate(path, path.stat().st_size // 2 | 1)


TROUBLES: dict[str, Callable[[Writer, Path, Whole, random.Random], int]] = {
    "full disk": _full,
    "read-only folder": _read_only,
    "a file vanishes": functools.partial(_meanwhile, change=Path.unlink),
    "a file is half there": functools.partial(_meanwhile, change=_half),
}


def _fresh(folder: Path, writer: Writer) -> Path:
    """An empty folder for one run; always the same, for some commands write down where they are."""
    place = folder / writer.name.replace(" ", "-")
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir()
    return place


def _finishes(writer: Writer, place: Path) -> bool:
    """Run to the end; whether that went well, or the work had been done before."""
    status = ended(writer.begin(place))
    good = status == 0 or bool(writer.refuses and writer.refuses in said(place))
    if not good:
        print(f"{writer.name}: the next run ended with {status}: {said(place)[-2000:]}", file=sys.stderr)
    return good


def _told(writer: Writer, what: str, files: list[str]) -> int:
    """How many files these are, after each was named."""
    for name in files:
        print(f"{writer.name}: {name} {what}", file=sys.stderr)
    return len(files)
