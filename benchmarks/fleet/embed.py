"""Recipe: describe the recordings of a fleet with Ray Data. Each worker holds a compiled model.

    pip install 'sglpr-jax[fleet]' 'ray[data]'
    python -m benchmarks.fleet.embed 's3://bucket/recordings/*' --out s3://bucket/places

The command can be repeated: recordings whose places are in the store are not described again.
"""

import contextlib
import os
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")

import fsspec
import tyro

import sglpr_jax
from sglpr_jax.methods.registry import network
from sglpr_jax.retrieval.parquet import embed_to_store


def main(
    recordings: tyro.conf.Positional[str], *, out: str, weights: str = "sglpr", site: str = "", workers: int = 2
) -> None:
    """Describe recordings on the Ray cluster of `RAY_ADDRESS`, or else on this machine.

    Args:
        recordings: pattern of the addresses of recordings, a folder or a bag each.
        out: store of places.
        weights: name of shipped weights, or a folder.
        site: where the recordings were made.
        workers: number of processes that hold a model.
    """
    filesystem, pattern = fsspec.core.url_to_fs(recordings)
    sources = [filesystem.unstrip_protocol(path) for path in sorted(filesystem.glob(pattern))]
    if not sources:
        raise SystemExit(f"{recordings}: expected recordings, found none")
    found = described(sources, out=out, weights=weights, site=site, workers=workers)
    failed = [row for row in found if row["error"]]
    added = sum(row["added"] for row in found)
    print(f"{len(found)} recordings: {added} places added to {out}, {len(failed)} recordings failed")
    for row in failed:
        print(f"{row['source']}: {row['error']}")


def described(
    sources: Sequence[str], *, workers: int, worker: type["Describer"] | None = None, **about: Any
) -> list[dict[str, Any]]:
    """Describe recordings with Ray Data. If a worker dies, Ray starts another, which repeats only its recording."""
    import ray.data

    rows = ray.data.from_items([{"source": source} for source in sources], override_num_blocks=len(sources))
    return rows.map(
        worker or Describer, fn_constructor_kwargs=about, compute=ray.data.ActorPoolStrategy(size=workers)
    ).take_all()


class Describer:
    """Describes one recording after the other with a model that is compiled once."""

    def __init__(self, *, out: str, weights: str = "sglpr", site: str = ""):
        self.out, self.site, self.method = out, site, network(sglpr_jax.load(weights))

    def __call__(self, row: dict[str, Any]) -> dict[str, Any]:
        """Describe the recording `row["source"]`. An unreadable recording is reported and does not stop the others."""
        try:
            with local_copy(row["source"]) as path:
                recording = sglpr_jax.open_recording(path)
                stored = embed_to_store(self.out, self.method, recording, site=self.site, source=row["source"])
            return row | {"address": stored.address, "added": stored.added or 0, "error": ""}
        except (OSError, ValueError) as error:
            return row | {"address": "", "added": 0, "error": str(error)}


@contextlib.contextmanager
def local_copy(source: str) -> Iterator[Path]:
    """A recording as files on this machine. A copy from object storage is removed at the end."""
    filesystem, path = fsspec.core.url_to_fs(source)
    if filesystem.protocol == "file" or "file" in filesystem.protocol:
        yield Path(path)
        return
    with tempfile.TemporaryDirectory() as folder:
        local = Path(folder) / Path(path).name
        filesystem.get(path, str(local), recursive=True)
        yield local


if __name__ == "__main__":
    tyro.cli(main)
