import dataclasses
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from sglpr_jax.retrieval.descriptor_file import DescriptorFile

from .conftest import assert_one_line_error

FILES = ("results.json", "precision-recall.png", "trajectory.png", "report.html", "command.json")
BIN = Path(__file__).resolve().parents[2] / "bin"


@pytest.fixture
def recording() -> DescriptorFile:
    """Two equal laps, described so that every place is found."""
    angle = np.arange(800) * (2 * np.pi / 400)
    place = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return DescriptorFile(
        sequence="08",
        ids=tuple(f"{i:06d}" for i in range(800)),
        positions=np.pad(200 * place, ((0, 0), (0, 1))),
        times=np.arange(800) * 0.5,
        descriptors=place.astype(np.float32),
        pose_source="sequences/08/poses.txt",
        config={"method": "made up"},
        weights_hash="abc",
    )


@pytest.mark.slow
def test_every_protocol_is_printed_written_and_drawn(command, recording, tmp_path):
    recording.save(tmp_path / "08.npz")
    ended = command("evaluate", tmp_path / "08.npz")
    assert ended.status == 0, ended.error
    for words in ("top-1 F1max", "pairs F1max", "Recall@1", "3 m / 20 m", "400 revisits", "3-D", "2-D"):
        assert words in ended.out
    assert ended.out.count("sequences/08/poses.txt") == 3
    scores, thresholds = 3, 2 * 3  # of each protocol, and three for each of two curves
    assert ended.out.count("1.000") == 3 * scores + 2 * thresholds  # an interval has two ends
    folder = tmp_path / "08"
    written = [Path(path) for path in re.findall(r"^written: (.*)$", ended.out, re.MULTILINE)]
    assert written == [folder / name for name in FILES]
    report = json.loads((folder / "results.json").read_text())
    assert [result["score"] for result in report["results"]] == [1, 1, 1]
    assert report["weights_hash"] == "abc" and report["config"] == {"method": "made up"}
    for path in written[1:3]:
        with Image.open(path) as picture:
            assert min(picture.size) > 200


@pytest.mark.slow
def test_the_record_beside_the_results_repeats_them(command, recording, tmp_path):
    recording.save(tmp_path / "08.npz")
    out = tmp_path / "out"
    assert command("evaluate", tmp_path / "08.npz", "--protocol", "top1-f1max", "--out", out).status == 0
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    shutil.move(out, tmp_path / "first")
    assert command("evaluate", "--config", tmp_path / "first" / "command.json").status == 0
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before
    assert len(json.loads(before["results.json"])["results"]) == 1


def test_without_matplotlib_the_table_is_all_and_the_extra_is_named(command, recording, tmp_path, monkeypatch):
    recording.save(tmp_path / "08.npz")
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    ended = command("evaluate", tmp_path / "08.npz")
    assert ended.status == 0 and "sglpr-jax[viz]" in ended.error
    assert sorted(path.name for path in (tmp_path / "08").iterdir()) == ["command.json", "report.html", "results.json"]
    assert "sglpr-jax[viz]" in (tmp_path / "08" / "report.html").read_text()


def test_descriptors_without_positions_cannot_be_scored(command, recording, tmp_path):
    dataclasses.replace(recording, positions=None, pose_source=None).save(tmp_path / "mine.npz")
    assert_one_line_error(
        command("evaluate", tmp_path / "mine.npz"), tmp_path / "mine.npz", "positions", "without poses"
    )
    assert not (tmp_path / "mine").exists()


@pytest.mark.slow
def test_a_file_of_another_kind_is_refused_without_a_traceback(command, tmp_path):
    assert_one_line_error(command("evaluate", tmp_path / "no.npz"), tmp_path / "no.npz", "found none")
    (tmp_path / "cut.npz").write_bytes(b"PK\3\4")
    call = [sys.executable, "-m", "sglpr_jax.cli.evaluate", str(tmp_path / "cut.npz")]
    ended = subprocess.run(call, capture_output=True, text=True)
    assert (ended.returncode, ended.stdout) == (1, "")
    assert ended.stderr.startswith(f"error: {tmp_path / 'cut.npz'}: expected a descriptor file")
    assert ended.stderr.count("\n") == 1


def test_every_script_of_bin_starts_a_command(command):
    for path in BIN.iterdir():
        assert path.stat().st_mode & 0o111, path
        module = re.search(r"-m (sglpr_jax\.cli\.)(\w+)", path.read_text())
        assert module or path.name in ("_python", "docs", "test")
        if module:
            assert module[2] == path.name and command(module[2], "--help").status == 0
