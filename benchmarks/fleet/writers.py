"""Two processes add places to an index while ten others query it, and one writer is killed (kill -9): nothing is lost.

python -m benchmarks.fleet.writers
"""

import multiprocessing
import os
import signal
import tempfile
import time
from pathlib import Path

import numpy as np
import tyro

from benchmarks.fleet.places import random_places
from sglpr_jax.retrieval.descriptor_file import DescriptorFile
from sglpr_jax.retrieval.fleet_index import FleetIndex
from sglpr_jax.retrieval.parquet import place_rows

WIDTH = 256
POLL_S = 0.05
"""Time between looks at the files, in seconds."""


def main(*, readers: int = 10, recordings: int = 40, scans: int = 100) -> None:
    """Run the processes, and compare the table with what the writers reported as added.

    Args:
        readers: number of processes that query.
        recordings: number of recordings that each writer adds. The first writer is killed after a quarter of them, and
            then started again.
        scans: number of scans of a recording.
    """
    context = multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        write = [context.Process(target=_write, args=(folder, w, recordings, scans)) for w in (0, 1, 0)]
        read = [context.Process(target=_read, args=(folder, r)) for r in range(readers)]
        for process in (*write[:2], *read):
            process.start()
        while len(_lines(folder, "writer-0")) < recordings // 4:
            time.sleep(POLL_S)
        os.kill(write[0].pid, signal.SIGKILL)
        write[0].join()
        acknowledged = len(_lines(folder, "writer-0"))
        write[2].start()
        for process in write[1:]:
            process.join()
        (folder / "stop").touch()
        for process in read:
            process.join()
        failed = sum(process.exitcode != 0 for process in (*write[1:], *read))
        answered = sum(int(line) for r in range(readers) for line in _lines(folder, f"reader-{r}"))
        _report(folder, acknowledged, failed=failed, answered=answered, scans=scans)


def _report(folder: Path, acknowledged: int, *, failed: int, answered: int, scans: int) -> None:
    index = FleetIndex(folder / "index")
    table = index.table.search().select(["recording"]).limit(None).to_arrow()
    counted = {one["values"]: one["counts"] for one in table["recording"].value_counts().to_pylist()}
    reported = {line for w in (0, 1) for line in _lines(folder, f"writer-{w}")}
    lost = sum(counted.get(name, 0) != scans for name in reported)
    parts = sum(count != scans for count in counted.values())
    index.optimize()
    print(f"a writer was killed after {acknowledged} recordings, and started again")
    print(f"{len(reported)} recordings reported as added, {lost} of them lost; {parts} of {len(counted)} incomplete")
    print(f"{len(index)} places after compaction; {answered} queries answered; {failed} processes failed")


def _write(folder: Path, writer: int, recordings: int, scans: int) -> None:
    """Add recordings, and report each when it is in the table."""
    index = FleetIndex(folder / "index", weights_hash="drawn")
    for number in range(recordings):
        rows = random_places(scans, WIDTH, np.random.default_rng((writer, number)))
        ids = tuple(f"{row:06d}" for row in range(scans))
        index.add(place_rows(DescriptorFile("drawn", ids, None, None, rows, None, {}, "drawn"), f"{writer}-{number}"))
        with (folder / f"writer-{writer}").open("a") as report:
            report.write(f"{writer}-{number}\n")


def _read(folder: Path, reader: int) -> None:
    """Query until the end."""
    rng, answered = np.random.default_rng((2, reader)), 0
    while not (folder / "stop").exists():
        index = FleetIndex(folder / "index", weights_hash="drawn")
        if len(index):
            assert len(index.query(random_places(1, WIDTH, rng)[0])) == 1
            answered += 1
    (folder / f"reader-{reader}").write_text(f"{answered}\n")


def _lines(folder: Path, name: str) -> list[str]:
    path = folder / name
    return path.read_text().splitlines() if path.exists() else []


if __name__ == "__main__":
    tyro.cli(main)
