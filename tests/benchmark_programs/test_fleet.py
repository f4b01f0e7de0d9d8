"""The recipes for a fleet, and what is measured of its index, on a few places."""

import jax
import numpy as np
import pytest

import sglpr_jax

from .programs import printed

pytestmark = pytest.mark.slow


@pytest.fixture
def weights(tmp_path):
    """A network of next to no arithmetic, in a folder."""
    grid = sglpr_jax.Grid(resolution_m=3.2, height=16, width=16)
    head = sglpr_jax.HeadConfig(channels=(8,), kernels=(4,), strides=(4,), cbam_reduction=4, clusters=4)
    backbone = sglpr_jax.SwinConfig(embed_dim=8, depths=(1,), heads=(2,), window=4)
    params = sglpr_jax.init(jax.random.key(0), config=sglpr_jax.ModelConfig(grid=grid, backbone=backbone, head=head))
    sglpr_jax.save(params, tmp_path / "tiny")
    return tmp_path / "tiny"


def test_the_files_of_two_ray_workers_are_those_of_one_process_although_one_is_killed(weights):
    output = printed("fleet.ray_killed", "--recordings", 6, "--scans", 2, "--weights", weights)
    assert "killed a worker: True" in output
    assert "6 recordings, 12 places, 0 errors" in output
    assert "6 of 6 files are those of one process, byte by byte; 6 files in the store" in output
    assert "three of them again: 0 places added" in output


def test_nothing_is_lost_when_a_writer_is_killed():
    output = printed("fleet.writers", "--readers", 1, "--recordings", 4, "--scans", 3)
    assert "8 recordings reported as added, 0 of them lost; 0 of 8 incomplete" in output
    assert "24 places after compaction" in output and "0 processes failed" in output


def test_an_index_tells_its_recall(tmp_path):
    rng = np.random.default_rng(0)
    np.savez(tmp_path / "drives.npz", a=rng.normal(size=(40, 16)).astype(np.float32))
    output = printed("fleet.index_size", "--drives", tmp_path / "drives.npz", "--places", 2000, "--queries", 3)
    assert "2,000 places: written in" in output and "bytes a place" in output
    assert "random, probes 64, refine 20: recall@1 1.0000" in output and "drives, probes 64" in output
