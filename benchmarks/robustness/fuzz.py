"""Damaged files of every format, for hours: each is read or refused by one clear error, and nothing else happens.

The formats and the damage are those of the tests (`tests/fuzz`). Each format is read in a process with a limit of
memory. Cases that are neither read nor refused are kept in `out`.
"""

import faulthandler
import multiprocessing
import os
import resource
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any, Literal, get_args

import hypothesis
from hypothesis import HealthCheck, Phase, given, settings

from benchmarks.table import Table
from tests.fuzz.damage import damaged, refused
from tests.fuzz.formats import FORMATS, Format

Outcome = Literal[
    "clear error", "warning", "silent", "unclear error", "traceback", "hang", "memory", "write outside", "crash"
]
OUTCOMES = get_args(Outcome)
GOOD = OUTCOMES[:3]
"""Outcomes of a case without a fault. A crash is the end of the process of a round, also by a library that hangs."""
SETTINGS = settings(
    max_examples=200,
    deadline=None,
    database=None,
    phases=[Phase.generate],
    suppress_health_check=list(HealthCheck),
)
"""Cases of a round."""


def fuzz(
    *,
    hours: float = 1.0,
    seed: int = 0,
    only: tuple[str, ...] = (),
    limit_gb: float = 1.5,
    limit_s: int = 20,
    out: Path = Path("build/fuzz"),
) -> None:
    """Read damaged files of each format in turn, and print the outcomes.

    Args:
        hours: time after which no further round begins.
        seed: seed of the first round.
        only: formats, by their names in tests/fuzz/formats.py. Empty: all.
        limit_gb: memory that reading may take, in 10^9 bytes.
        limit_s: seconds that a case may take.
        out: folder for the cases with a fault.
    """
    begin, outcomes, rounds = time.monotonic(), {name: Counter[str]() for name in only or FORMATS}, 0
    while not rounds or time.monotonic() - begin < 3600 * hours:
        for name, counts in outcomes.items():
            counts.update(_in_process(name, seed + rounds, int(limit_gb * 1e9), limit_s, out))
        rounds += 1
    table = Table("format", "cases", *OUTCOMES)
    for name, counts in (*outcomes.items(), ("all", sum(outcomes.values(), Counter[str]()))):
        table.add(name, str(sum(counts.values())), *(str(counts[outcome]) for outcome in OUTCOMES))
    print(f"{rounds} rounds, seeds {seed} to {seed + rounds - 1}")


def _in_process(*of_round: Any) -> Counter[str]:
    """Outcomes of a round (arguments of `_outcomes`) in a process of its own."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        try:
            return pool.submit(_outcomes, *of_round).result()
        except BrokenProcessPool:
            return Counter(["crash"])


def _outcomes(name: str, seed: int, limit_bytes: int, limit_s: int, out: Path) -> Counter[str]:
    """Outcomes of the cases of a round. Reading may take `limit_bytes` of memory, and a case `limit_s` seconds."""
    format, counts = FORMATS[name], Counter[str]()
    used = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    resource.setrlimit(resource.RLIMIT_AS, (used + limit_bytes, resource.RLIM_INFINITY))
    signal.signal(signal.SIGALRM, _raise_timeout)
    written = _paths_written_outside()

    @hypothesis.seed(seed)
    @settings(SETTINGS)
    @given(damaged(format.whole))
    def read(content: bytes) -> None:
        written.clear()
        outcome, error = _outcome(format, content, limit_s)
        if written and outcome in GOOD:
            outcome, error = "write outside", "\n".join(written)
        counts[outcome] += 1
        if outcome not in GOOD:
            out.mkdir(parents=True, exist_ok=True)
            stem = out / f"{name.replace(' ', '-').replace('/', '-')}-{seed}-{counts[outcome]}"
            stem.with_suffix(".bin").write_bytes(content)
            stem.with_suffix(".txt").write_text(f"{outcome}\n{error}")

    read()
    return counts


def _outcome(format: Format, content: bytes, limit_s: int) -> tuple[Outcome, str]:
    """Outcome of reading a damaged file, and its error."""
    signal.alarm(limit_s)
    faulthandler.dump_traceback_later(2 * limit_s, exit=True)  # a library may not return for the alarm
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            is_refused = refused(format, content)
        return ("clear error" if is_refused else "warning" if caught else "silent"), ""
    except AssertionError as error:
        return "unclear error", str(error)
    except _Timeout:
        return "hang", f"more than {limit_s} s"
    except MemoryError as error:
        return "memory", str(error)
    except Exception:  # the fault that is sought: it is counted, and kept with its case
        return "traceback", traceback.format_exc()
    finally:
        signal.alarm(0)
        faulthandler.cancel_dump_traceback_later()


def _paths_written_outside() -> list[str]:
    """List to which Python adds each file outside the folder for temporary files that it opens for writing."""
    paths = list[str]()

    def listen(event: str, arguments: tuple) -> None:
        if event == "open" and isinstance(arguments[0], str) and arguments[2] & (os.O_WRONLY | os.O_RDWR):
            path = os.path.realpath(arguments[0])
            if not path.startswith((os.path.realpath(tempfile.gettempdir()), "/dev/")):
                paths.append(path)

    sys.addaudithook(listen)
    return paths


class _Timeout(BaseException):
    """A case takes too long. Not an Exception, so that no reader turns it into a clear error."""


def _raise_timeout(*_: object) -> None:
    raise _Timeout
