"""Commands that are given a damaged file end in one line that names it, with status 1, and write nothing."""

from pathlib import Path
from random import Random

import numpy as np
import pytest
from cli.conftest import assert_one_line_error, run_command

from .archives import DESCRIPTOR_FILE
from .damage import BYTES
from .road import N
from .roads import FILE_ROADS
from .rows import TWELVE

CASES = 5
COMMANDS = {
    "descriptor file": ("evaluate", "{file}"),
    "matrix": ("evaluate", "{file}", "--poses", "good/poses.txt", "--pose-format", "lidar"),
    "top-k list": ("evaluate", "{file}", "--poses", "good/poses.txt", "--pose-format", "lidar"),
    "scored pairs": ("evaluate", "{file}", "--poses", "good/poses.txt", "--pose-format", "lidar"),
    "KITTI poses": ("evaluate", "good/08.npz", "--poses", "{file}", "--pose-format", "kitti"),
    "TUM poses": ("embed", "--method", "solid", "--data", "good/scans", "--poses", "{file}", "--out", "out.npz"),
    "times": ("evaluate", "good/08.npz", "--poses", "good/poses.txt", "--pose-format", "lidar", "--times", "{file}"),
    "weights": ("export", "--weights", "bad", "--out", "out"),
}
"""By the road of the damaged file, which lies in the folder `bad`."""


@pytest.mark.parametrize("name", COMMANDS)
@pytest.mark.parametrize("seed", range(CASES))
def test_a_command_refuses_a_damaged_file(name, seed, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path.parent / "cache"))
    road, draw = FILE_ROADS[name], Random(seed)
    for path, content in {
        "good/poses.txt": TWELVE,
        "good/08.npz": DESCRIPTOR_FILE,
        **{f"good/scans/{i}.bin": np.full((9, 4), i, "<f4").tobytes() for i in range(N)},
        **{f"bad/{other}": content for other, content in road.beside.items()},
        f"bad/{road.file}": BYTES["other_kind"](road.whole, draw).content or b"?",
    }.items():
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        Path(path).write_bytes(content)
    before = sorted(tmp_path.rglob("*"))
    command, *arguments = (word.format(file=f"bad/{road.file}") for word in COMMANDS[name])
    assert_one_line_error(run_command(command, *arguments), road.file, "expected", "found")
    assert sorted(tmp_path.rglob("*")) == before
