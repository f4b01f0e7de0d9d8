import pytest

from sglpr_jax.cli import datasets
from sglpr_jax.cli.datasets import dataset_root, leave_one_out


def test_all_drives_but_one_are_trained_on(town, capsys):
    recordings, test = leave_one_out(town, "08")
    assert [recording.name for recording in recordings] == ["00", "05"]
    assert test.name == "08"
    said = capsys.readouterr().err.splitlines()
    assert said[0] == "training on 00, 05; testing on 08, which is held out"
    assert [line.split(";")[:2] for line in said[1:]] == [
        [f"{name}: 40 scans", " format: kitti (16 bytes a point)"] for name in ("00", "05", "08")
    ]


def test_a_drive_that_is_tested_is_never_trained_on(town):
    with pytest.raises(ValueError, match="other than '08', found 00, 08"):
        leave_one_out(town, "08", train_seqs=("00", "08"))


@pytest.mark.parametrize(("seq", "train_seqs"), [("8", ()), ("08", ("00", "11"))])
def test_an_unknown_drive_lists_those_that_exist(town, seq, train_seqs):
    with pytest.raises(FileNotFoundError, match=r"expected sequence '(8|11)', found 00, 05, 08"):
        leave_one_out(town, seq, train_seqs=train_seqs)


def test_without_a_dataset_it_says_what_it_simulates_and_where_kitti_would_go(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    asked = {}
    monkeypatch.setattr(datasets, "simulate", lambda root, **options: asked.update(options, root=root))
    root = dataset_root(None)
    assert root == asked["root"] and root.is_relative_to(tmp_path / "sglpr-jax")
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert str(root) in said and "--data" in said and "sequences/NN/velodyne" in said
