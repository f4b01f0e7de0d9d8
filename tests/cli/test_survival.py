"""A search that is killed while it writes a file, and begun again, ends with the same files as one that was not."""

import os
from pathlib import Path

import pytest

from sglpr_jax.cli.config_file import COMMAND_FILE
from sglpr_jax.loops import candidates

from .conftest import run_command


class Killed(BaseException):
    """No program handles this."""


def contents(folder: Path, *line: object) -> dict[str, bytes]:
    """Files of a search that ends, without the one that names the folder."""
    ended = run_command(*line, "--out", folder)
    assert ended.status == 0, ended.error
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file() and path.name != COMMAND_FILE}


@pytest.mark.slow
def test_a_killed_search_ends_with_the_files_of_one_that_was_not_killed(walk, tmp_path, monkeypatch):
    line, replace = ("loops", walk / "scans", "--min-probability", "0.5", "--no-register"), os.replace
    whole = contents(tmp_path / "whole", *line)
    assert whole["loops.jsonl"]

    def killed(source: Path, path: Path) -> None:
        if Path(path).name == "index.html":
            raise Killed
        replace(source, path)

    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(os, "replace", killed)
        run_command(*line, "--out", tmp_path / "out")
    monkeypatch.setattr(candidates, "describe_scan", lambda *_: pytest.fail("a stored scan was described again"))
    assert contents(tmp_path / "out", *line) == whole
