"""One command of `writers`, disturbed: killed, run twice at once, without room or rights, its input changed."""

import contextlib
import os
import random
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

from benchmarks.robustness.writers import (
    ERRORS,
    INPUTS,
    OUT,
    Process,
    Writer,
    begin,
    differing,
    ended,
    left_behind,
    missing,
    said,
    written,
)


class Whole(NamedTuple):
    """An undisturbed run."""

    files: dict[str, bytes]
    seconds: float
    changes: int
    """How often something changed in its folder."""


def undisturbed(writer: Writer, folder: Path) -> Whole:
    """Run twice: the first run compiles, and the second has to end with the same bytes."""
    runs = []
    for _ in range(2):
        place, start = _fresh(folder, writer), time.perf_counter()
        process = begin(writer, place)
        changes = sum(1 for _ in changing(process, place))
        assert ended(process) == 0, f"{writer.name}: {said(place)}"
        runs.append(Whole(written(place), time.perf_counter() - start, changes))
    unlike = differing(writer, runs[1].files, runs[0].files)
    assert not unlike and runs[1].files, f"{writer.name}: two runs differ in {', '.join(unlike)}"
    return runs[1]


def changing(process: Process, folder: Path) -> Iterator[None]:
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


def killed(writer: Writer, folder: Path, *, kills: int, seed: int) -> tuple[Whole, dict[str, int]]:
    """Kill it so often, each time in a fresh folder, and let it run again.

    Every second kill comes at any time of the run, the others within 5 ms of any of the changes in its folder. Counts
    kills, those in the middle of writing, files that are half there under their own names, next runs that fail, and
    other bytes after them.
    """
    draw, whole = random.Random(f"{seed} {writer.name}"), undisturbed(writer, folder)
    counts = dict.fromkeys(("kills", "in the middle", "half-written", "next run fails", "other bytes"), 0)
    for attempt in range(3 * kills):
        if counts["kills"] == kills:
            break
        place = _fresh(folder, writer)
        process = begin(writer, place)
        if attempt % 2:
            _wait_for_changes(process, place, draw.randint(1, whole.changes))
            time.sleep(draw.uniform(0, 5e-3))
        else:
            time.sleep(draw.uniform(0, whole.seconds))
        process.kill()
        if ended(process) >= 0:
            continue  # it was faster
        found = written(place)
        counts["kills"] += 1
        counts["in the middle"] += bool(left_behind(place)) or 0 < len(found) < len(whole.files)
        counts["half-written"] += _told(writer, "is not whole", differing(writer, found, whole.files))
        if not _finishes(writer, place):
            counts["next run fails"] += 1
        else:
            counts["other bytes"] += _told(writer, "is another one after the next run", _unlike(writer, place, whole))
    return whole, counts


def together(writer: Writer, folder: Path, *, times: int) -> dict[str, int]:
    """Start it twice at once, so often. Counts how often both ended well, one was refused in one line, one or both
    failed, and other bytes.
    """
    whole = undisturbed(writer, folder)
    counts = dict.fromkeys(("both end well", "one is refused", "fail", "other bytes"), 0)
    for _ in range(times):
        place = _fresh(folder, writer)
        errors = (f"{ERRORS}-0", f"{ERRORS}-1")
        processes = [begin(writer, place, errors=name) for name in errors]
        statuses = [ended(process) for process in processes]
        bad = [said(place, name) for name, status in zip(errors, statuses, strict=True) if status]
        refused = len(bad) == 1 and is_one_line(bad[0])
        counts["both end well" if not bad else "one is refused" if refused else "fail"] += 1
        for error in bad:
            print(f"{writer.name}: one of two ended with: {error[-2000:]}", file=sys.stderr)
        counts["other bytes"] += _told(writer, "is another one after two at once", _unlike(writer, place, whole))
    return counts


def troubled(writer: Writer, folder: Path, *, times: int, seed: int) -> dict[str, dict[str, int]]:
    """Let it run with each of `TROUBLES`, so often. Counts how often it was refused in one line, ended well, ended in
    anything else, and files that are half there under their own names, or others than in a good run.
    """
    draw, whole, found = random.Random(f"{seed} {writer.name}"), undisturbed(writer, folder), {}
    for name, trouble in TROUBLES.items():
        counts = found[name] = dict.fromkeys(("refused in one line", "ends well", "anything else", "half-written"), 0)
        for _ in range(times):
            place = _fresh(folder, writer)
            status = trouble(writer, place, whole, draw)
            refused = status == 1 and is_one_line(said(place))
            kind = "ends well" if status == 0 else "refused in one line" if refused else "anything else"
            if kind == "anything else":
                print(f"{writer.name}, {name}: status {status}: {said(place)[-2000:]}", file=sys.stderr)
            counts[kind] += 1
            unlike = differing(writer, written(place), whole.files)
            counts["half-written"] += _told(writer, f"is not whole: {name}", unlike)
    return found


def is_one_line(error: str) -> bool:
    """Whether a command ended as it should where something is wrong."""
    return error.rstrip("\n").splitlines()[-1:] != [] and (
        error.rstrip("\n").splitlines()[-1].startswith("error: ") and "Traceback" not in error
    )


def _full(writer: Writer, place: Path, whole: Whole, draw: random.Random) -> int:
    """No file may grow beyond a part of the largest one: to a program that is a full disk, and it takes no rights."""
    largest = max(len(content) for content in whole.files.values())
    return ended(begin(writer, place, file_bytes=draw.randrange(largest)))


def _read_only(writer: Writer, place: Path, whole: Whole, draw: random.Random) -> int:
    """Nobody may write into the folder."""
    (place / OUT).mkdir(parents=True)
    (place / OUT).chmod(0o555)
    status = ended(begin(writer, place, humble=True))
    (place / OUT).chmod(0o755)
    return status


def _vanishes(writer: Writer, place: Path, whole: Whole, draw: random.Random) -> int:
    """One of the files that it reads is removed meanwhile."""
    return _meanwhile(writer, place, whole, draw, Path.unlink)


def _half_there(writer: Writer, place: Path, whole: Whole, draw: random.Random) -> int:
    """One of the files that it reads is written anew meanwhile, and has come as far as the middle of a number."""
    return _meanwhile(writer, place, whole, draw, lambda path: os.truncate(path, path.stat().st_size // 2 | 1))


TROUBLES: dict[str, Callable[[Writer, Path, Whole, random.Random], int]] = {
    "full disk": _full,
    "read-only folder": _read_only,
    "a file vanishes": _vanishes,
    "a file is half there": _half_there,
}


def _meanwhile(writer: Writer, place: Path, whole: Whole, draw: random.Random, change: Callable[[Path], None]) -> int:
    """Change a file that the command names, or a scan of the drive that it names, at any time of its run."""
    inputs, before = place.parent / INPUTS, place.parent / "inputs-before"
    shutil.copytree(inputs, before)
    try:
        scans = sorted((inputs / "town/sequences/08/velodyne").iterdir())
        named = [place / word for word in writer.arguments if word.startswith(f"../{INPUTS}/")]
        process = begin(writer, place)
        time.sleep(draw.uniform(0, whole.seconds))
        change(draw.choice([*scans[-len(named) :], *(one for one in named if one.is_file())]))
        return ended(process)
    finally:
        shutil.rmtree(inputs)
        before.rename(inputs)


def _fresh(folder: Path, writer: Writer) -> Path:
    """An empty folder for one run; always the same, for some commands write down where they are."""
    place = folder / writer.name.replace(" ", "-")
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir()
    return place


def _wait_for_changes(process: Process, place: Path, count: int) -> None:
    for done, _ in enumerate(changing(process, place), 1):
        if done == count:
            return


def _finishes(writer: Writer, place: Path) -> bool:
    """Run to the end; whether that went well, or the work had been done before."""
    status = ended(begin(writer, place))
    good = status == 0 or bool(writer.refuses and writer.refuses in said(place))
    if not good:
        print(f"{writer.name}: the next run ended with {status}: {said(place)[-2000:]}", file=sys.stderr)
    return good


def _unlike(writer: Writer, place: Path, whole: Whole) -> list[str]:
    found = written(place)
    return [*differing(writer, found, whole.files), *missing(writer, found, whole.files)]


def _told(writer: Writer, what: str, files: list[str]) -> int:
    """How many files these are, after each was named."""
    for name in files:
        print(f"{writer.name}: {name} {what}", file=sys.stderr)
    return len(files)
