"""The recipe `benchmarks.fleet.embed` with two Ray workers, one of them killed: its files against those of one process.

python -m benchmarks.fleet.ray_killed --recordings 64
"""

import os
import shutil
import signal
import tempfile
from pathlib import Path
from typing import Any

os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")

import fsspec
import numpy as np
import tyro

import sglpr_jax
from benchmarks.fleet.embed import Describer, described
from sglpr_jax.retrieval.parquet import read_places, stored_places


def main(
    *, recordings: int = 64, scans: int = 10, weights: str = "sglpr", workers: int = 2, folder: Path | None = None
) -> None:
    """Describe simulated recordings twice, and compare the files of both stores byte by byte.

    Args:
        recordings: number of recordings, parts of one simulated drive.
        scans: scans of a recording.
        weights: shipped weights, or a folder.
        workers: Ray workers. One is killed at a third of the recordings.
        folder: folder for everything. None: a temporary folder.
    """
    import ray

    with tempfile.TemporaryDirectory(prefix="ray") as temporary:
        root = folder or Path(temporary)
        sources = _simulated(root, recordings, scans)
        alone = Describer(out=f"{root}/alone/", weights=weights)
        for source in sources:
            alone({"source": source})
        options = {"include_dashboard": False, "log_to_driver": False, "configure_logging": False}
        here = str(Path(__file__).resolve().parents[2])
        environment = {"env_vars": {"PYTHONPATH": f"{here}:{os.environ.get('PYTHONPATH', '')}"}}
        ray.init(
            "local",
            num_cpus=workers,
            object_store_memory=10**8,
            _temp_dir=temporary,
            runtime_env=environment,
            **options,
        )
        try:
            about = {
                "out": f"{root}/places/",
                "weights": weights,
                "victim": sources[recordings // 3],
                "mark": f"{root}/killed",
            }
            found = described(sources, worker=KilledOnce, workers=workers, **about)
        finally:
            ray.shutdown()
        again = [Describer(out=f"{root}/places/", weights=weights)({"source": source}) for source in sources[:3]]
        _report(root, found, again)


def _simulated(root: Path, recordings: int, scans: int) -> list[str]:
    """Write one drive, divided into recordings. Returns their folders."""
    sglpr_jax.simulate(root / "town", routes=["08"], scans=recordings * scans, azimuth_steps=120)
    files = sorted((root / "town" / "sequences" / "08" / "velodyne").iterdir())
    for number, part in enumerate(np.split(np.arange(len(files)), recordings)):
        (root / "recordings" / f"{number:03d}").mkdir(parents=True)
        for row in part:
            shutil.move(files[row], root / "recordings" / f"{number:03d}")
    return [str(path) for path in sorted((root / "recordings").iterdir())]


class KilledOnce(Describer):
    """A worker that is killed (kill -9) at one recording, the first time."""

    def __init__(self, *, victim: str, mark: str, **about: str):
        super().__init__(**about)
        self.victim, self.mark = victim, Path(mark)

    def __call__(self, row: dict[str, Any]) -> dict[str, Any]:
        """Describe a recording, or die."""
        if row["source"] == self.victim and not self.mark.exists():
            self.mark.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return super().__call__(row)


def _report(root: Path, found: list[dict], again: list[dict]) -> None:
    ours, theirs = (
        {Path(address).name: address for address in stored_places(f"{root}/{name}/")} for name in ("places", "alone")
    )
    same = [_content(ours[name]) == _content(theirs[name]) for name in theirs if name in ours]
    print(f"killed a worker: {(root / 'killed').exists()}")
    rows = sum(len(read_places(address)) for address in ours.values())
    print(f"{len(found)} recordings, {rows} places, {sum(bool(row['error']) for row in found)} errors")
    print(f"{sum(same)} of {len(theirs)} files are those of one process, byte by byte; {len(ours)} files in the store")
    print(f"three of them again: {sum(row['added'] for row in again)} places added")


def _content(address: str) -> bytes:
    filesystem, path = fsspec.core.url_to_fs(address)
    return filesystem.cat_file(path)


if __name__ == "__main__":
    tyro.cli(main)
