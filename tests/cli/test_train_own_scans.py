"""bin/train on scans of the user: flags for format and mounting, and skipped bad scans."""

import shutil

import pytest

from sglpr_jax.cli.train import TrainCommand, open_recordings


@pytest.fixture
def damaged(town, tmp_path):
    """The town with an empty scan in 00, and one of zeros in 08, which is tested."""
    root = shutil.copytree(town, tmp_path / "town")
    (root / "sequences/00/velodyne/000003.bin").write_bytes(b"")
    scan = root / "sequences/08/velodyne/000005.bin"
    scan.write_bytes(bytes(scan.stat().st_size))
    return root


def test_bad_scans_are_skipped_before_the_training(damaged, capsys):
    command = TrainCommand(seq="08", data=(damaged,), skip_bad=True, sensor_height=1.73)
    (first, second), _, test = open_recordings(command)
    said = capsys.readouterr().err
    assert "skipped 000003: " in said and "skipped 000005: scan 000005 of sequence 08" in said and "as given" in said
    assert (len(first), len(second), len(test)) == (39, 40, 39) and "000005" not in test.ids
