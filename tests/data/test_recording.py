"""A recording has everything once for each scan, and opens each file of a record once."""

import collections
from pathlib import Path

import numpy as np
import pytest
from recordings import of_scans

from sglpr_jax.data.corruption import Corruption, corrupted
from sglpr_jax.data.formats import bin_records, scan_files
from sglpr_jax.data.readers import open_recording
from sglpr_jax.grid import Grid
from sglpr_jax.methods.recipe import TupleConfig
from sglpr_jax.methods.registry import handcrafted
from sglpr_jax.retrieval.embed import embed
from sglpr_jax.training.batches import read_batch
from sglpr_jax.training.tuples import TuplePool


@pytest.fixture
def opened(monkeypatch) -> collections.Counter:
    """How often each file of points or labels was opened, by its name."""
    counts: collections.Counter = collections.Counter()

    def fromfile(path: Path, **options):
        counts[path.name] += 1
        return np.fromfile(path, **options)

    real = scan_files.np

    class Counted:
        def __getattr__(self, name: str):
            return fromfile if name == "fromfile" else getattr(real, name)

    for module in (bin_records, scan_files):
        monkeypatch.setattr(module, "np", Counted())
    return counts


@pytest.fixture
def recording(kitti_root):
    return open_recording(kitti_root, "08")


def test_lasers_come_from_the_read_of_the_points(tmp_path, opened):
    points = np.random.default_rng(0).normal(scale=10, size=(64, 5)).astype("<f4")
    points[:, 4] = np.arange(64) % 32
    points.tofile(tmp_path / "0.bin")
    recording = open_recording(tmp_path, format="nuscenes")
    scan = recording.scan(0)
    assert scan.name == f"scan 0 of sequence {tmp_path.name}"
    np.testing.assert_array_equal(scan.lasers, np.arange(64) % 32)
    opened.clear()
    left = corrupted(recording, Corruption("beams", 16.0), seed=0).scan(0)
    assert len(left.points) == len(left.lasers) == 32 and opened == {"0.bin": 1}


def test_a_batch_and_an_embedding_open_each_file_once_a_place(recording, opened):
    pool = TuplePool([np.zeros((3, 3))], TupleConfig(negatives=0))
    frames = np.array([[0, 2], [2, 0], [0, 2]])
    batch = read_batch([recording], pool, frames, max_points=8, share_negatives=False)
    assert batch.labelled.all() and opened == {  # 6 places, 12 reads; 18 when labels read the scan again
        name: 3 for name in ("000000.bin", "000000.label", "000003.bin", "000003.label")
    }
    opened.clear()
    embed(handcrafted("solid", Grid()), recording)
    assert sum(opened.values()) == 3


CLOUDS = {Path(f"{i}.bin"): np.ones((5, 3), np.float32) for i in range(3)}


@pytest.mark.parametrize(
    "fields, message",
    [
        ({"positions": np.zeros((5, 3))}, "sequence 08: expected 3 positions, one per scan, found 5"),
        ({"ids": ("0", "1", "1")}, "expected a unique id for each scan, found '1' twice"),
    ],
)
def test_a_recording_needs_one_value_per_scan(fields, message):
    assert len(of_scans(CLOUDS)) == 3
    with pytest.raises(ValueError, match=message):
        of_scans(CLOUDS, **fields)
