"""A run that is killed while it writes a file, and begun again, ends with the same files as one that was not."""

import contextlib
import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from sglpr_jax.cli.config_file import COMMAND_FILE
from sglpr_jax.loops import candidates
from sglpr_jax.training.callbacks import ProgressBar
from sglpr_jax.training.metrics_log import read_metrics

from .conftest import run_command

pytestmark = pytest.mark.slow
TIMES = {"steps_per_second", "data_wait"}


class Killed(BaseException):
    """No program handles this."""


@contextlib.contextmanager
def before(name: str, action: Callable[[], None]) -> Iterator[None]:
    """Act before a file or folder of this name takes its place."""
    replace = os.replace

    def replace_later(source: Path, path: Path) -> None:
        if Path(path).name == name:
            action()
        replace(source, path)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "replace", replace_later)
        yield


def killed(name: str, *line: object) -> None:
    """Run a command line that is killed before a file of this name takes its place."""

    def kill() -> None:
        raise Killed(name)

    with pytest.raises(Killed), before(name, kill):
        run_command(*line)


def contents(folder: Path) -> dict[str, bytes]:
    """Files of a complete run, without the one that names the folder."""
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file() and path.name != COMMAND_FILE}


def finished(folder: Path, *line: object) -> Path:
    ended = run_command(*line, "--out", folder)
    assert ended.status == 0, ended.error
    return folder


def test_a_search(walk, tmp_path, monkeypatch):
    line, out = ("loops", walk / "scans", "--min-probability", "0.5", "--no-register"), tmp_path / "out"
    whole = contents(finished(tmp_path / "whole", *line))
    assert whole["loops.jsonl"]
    killed("index.html", *line, "--out", out)
    monkeypatch.setattr(candidates, "describe_scan", lambda *_: pytest.fail("a stored scan was described again"))
    assert contents(finished(out, *line)) == whole


def test_a_training(images, preset, tmp_path):
    head = ("--model.head.input", "counts", "--model.head.cbam", "False", "--method", "polar-fft")
    steps = ("--steps", 6, "--log-every", 2, "--score-every", 2)
    line = ("train", "--seq", "06", "--data", images, "--preset", preset, *steps, *head)
    whole, out = finished(tmp_path / "whole", *line), tmp_path / "out"
    with before("2", lambda: os.kill(os.getpid(), signal.SIGTERM)):  # the first checkpoint
        ended = run_command(*line, "--out", out)
    assert ended.status == 0 and "continue with --resume" in ended.error
    for name in ("4", "weights"):
        killed(name, *line, "--out", out, "--resume")
    finished(out, *line, "--resume")
    measured = [
        [{key: value for key, value in row.items() if key not in TIMES} for row in read_metrics(run / "metrics.jsonl")]
        for run in (out, whole)
    ]
    assert measured[0] == measured[1]
    assert contents(out / "weights") == contents(whole / "weights")
    for folder in (".", "checkpoints", "weights", "test"):
        assert sorted(os.listdir(out / folder)) == sorted(os.listdir(whole / folder))


def test_the_packing_before_a_training(images, preset, tmp_path, monkeypatch):
    monkeypatch.setattr(ProgressBar, "on_pack", lambda *_: os.kill(os.getpid(), signal.SIGTERM))
    options = ("--data", images, "--preset", preset, "--out", tmp_path / "out", "--cache", tmp_path / "cache")
    ended = run_command("train", "--seq", "06", *options)
    assert ended.status == 0 and "stopped while packing 00; run the same command again" in ended.error, ended.error
    assert not list(tmp_path.glob("*/*"))
