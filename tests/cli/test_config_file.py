"""--dump-config prints flag values that --config reads unchanged. Wrong files give an error of one line."""

import json
import re
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from sglpr_jax.cli.__main__ import COMMANDS, load_command
from sglpr_jax.cli.config_file import record_command
from sglpr_jax.cli.runtime import parse_command

from .conftest import assert_one_line_error, run_command

LINES = {
    "convert": ("swin.safetensors", "--out", "start", "--network", "swin-unet", "--seed", "3"),
    "demo": ("--scans", "40"),
    "embed": ("--data", "scans", "--out", "07.npz", "--seq", "07", "--sensor-height", "2", "--rotate"),
    "evaluate": ("a.npz", "b.npz", "--database", "c.npz", "--protocol", "all", "--seq", "no"),
    "export": ("--out", "mine", "--average", "1e3", "--shares", "1", "1e-4", "--image", "density"),
    "live": ("folder:scans", "--out", "map", "--sinks", "json", "json:a", "--rate", "0", "--topic", "1e3"),
    "loops": ("scans", "--out", "found", "--seq", "1_0", "--keyframe-m", "1e-1", "--candidates.recent-m", "50"),
    "map": ("scans", "--poses", "poses.tum", "--out", "a.safetensors", "--spacing-m", "0", "--skip-bad"),
    "peers": ("train", "rinet", "towns", "1e3", "--out", "run", "--learning-rate", "1e-3", "--held-out", "no"),
    "relocalize": ("drive", "--map", "a.safetensors", "--frame", "0", "--sensor-height", "estimate"),
    "reproduce": ("table1", "figure5", "--preset", "paper", "--seq", "00", "07", "--loss.margin", "0.25"),
    "segment": ("--data", "scans", "--out", "maps", "--min-confidence", "1", "--seq", "null"),
    "simulate": ("--out", "towns", "--seq", "00", "05", "--sensor", "vlp16", "--rate-hz", "5"),
    "train": ("--seq", "07", "--preset", "sglpr-small", "--model.head.cbam", "True", "--optimizer.clip-norm", "None"),
}
"""A command line of each command, with texts that YAML or a careless reader takes for other values."""
ROOT = Path(__file__).resolve().parents[2]
TINY = ROOT / "tests" / "tiny.py"


def parsed(name: str, *arguments: object) -> Any:
    """Return the command that `bin/<name> <arguments>` runs."""
    return parse_command(load_command(name)[0], name, [str(word) for word in arguments])


@pytest.fixture
def file(tmp_path) -> Callable[..., Path]:
    """`file(values)` writes a file for --config."""

    def write(values: object) -> Path:
        path = tmp_path / "mine.json"
        path.write_text(values if isinstance(values, str) else json.dumps(values))
        return path

    return write


def test_every_command_is_tested():
    assert LINES.keys() == COMMANDS.keys()


@pytest.mark.parametrize("name", LINES)
def test_a_dump_gives_the_same_command_and_has_the_flags_of_the_help(name, tmp_path):
    ended = run_command(name, *LINES[name], "--dump-config")
    assert ended.status == 0 and not ended.error
    (tmp_path / "dump.json").write_text(ended.out)
    assert parsed(name, "--config", tmp_path / "dump.json") == parsed(name, *LINES[name])
    shown = run_command(name, "--help").out
    flags = set(re.findall(r"^\W*(--[a-z][a-z0-9-]+)", shown, re.MULTILINE))
    positional = {"checkpoint", "recording", "scan", "file", "more", "source", "what"}
    positional |= {"action", "method", "data"} if name == "peers" else set()
    dumped = {f"--{flag}" for flag in json.loads(ended.out) if flag not in positional and "." not in flag}
    hidden = {"--topic-prefix", "--map-frame", "--odometry-frame"}
    assert dumped - hidden <= flags and {"--config", "--dump-config"} <= flags - dumped
    assert len(flags) <= 34


def test_flags_override_the_file_and_the_file_overrides_the_defaults(file):
    path = file({"recording": "scans", "out": "found", "seq": "07", "register": True, "candidates.cohort": 5})
    found = parsed("loops", "drive", "--config", path, "--seq", "08", "--no-register", "--candidates.candidates", "7")
    assert (found.recording, found.out, found.source.seq) == (Path("drive"), Path("found"), "08")
    assert (found.register, found.decision.candidates.candidates, found.decision.candidates.cohort) == (False, 7, 5)
    assert found.decision.candidates.further == 32


@pytest.mark.parametrize("name", ["train", "reproduce"])
def test_the_file_may_name_the_preset_and_overrides_it(name, file):
    path = file({"preset": "paper", "steps": 5, "optimizer.learning-rate": 1})
    found = parsed(name, "--config", path, "--loss.margin", "0.5")
    assert found.preset == "paper" and found.config.model == parsed(name, "--preset", "paper").config.model
    assert (found.config.steps, found.config.loss.margin) == (5, 0.5)
    assert found.config.optimizer.learning_rate == 1.0 and type(found.config.optimizer.learning_rate) is float
    other = parsed(name, f"--config={path}", "--preset", TINY)
    assert (other.preset, other.config.steps) == (str(TINY), 5)
    assert other.config.model == parsed(name, "--preset", TINY).config.model


@pytest.mark.parametrize(
    ("name", "values", "words"),
    [
        ("loops", "seq: 07", "expected JSON, found invalid JSON"),
        ("loops", [], "expected an object with a value for each flag, found []"),
        ("loops", {"min_probability": 1}, "found 'min_probability'; did you mean 'min-probability'?"),
        ("loops", {"seq": 7}, "seq: expected a value of type str, found 7"),
        ("loops", {"verification.turns": 3}, "verification: expected turns to be a multiple of 4, found 3"),
        ("train", {"preset": "smal"}, "preset: no preset 'smal': expected a .py file or one of"),
    ],
)
def test_a_wrong_file_is_one_line(name, values, words, file):
    path = file(values)
    assert_one_line_error(run_command(name, "--config", path), f"error: {path}: ", words)


def test_a_wrong_setting_or_a_missing_file_is_one_line(tmp_path):
    for arguments, words in (
        (("--candidates.candidats", "7"), "found '--candidates.candidats'; did you mean '--candidates.candidates'?"),
        (("--candidates.candidates=x",), "--candidates.candidates: expected a value of type int, found 'x'"),
        (("--verification.coarse", "0"), "--verification.coarse: expected a number from 1 up to 1048576, found 0"),
        (("--verification.reach-m", "-5"), "--verification.reach-m: expected a number above 0, found -5"),
        (("--verification.wide-blur-m", "0.3"), "verification: expected wide_blur_m above blur_m (0.4), found 0.3"),
        (("--drift-percent", "-1"), "--drift-percent: expected a number from 0, found -1.0"),
        (("--max-places", "0"), "--max-places: expected a number from 1"),
        (("--config", tmp_path / "mine.json"), "mine.json: expected a JSON file, found none"),
    ):
        assert_one_line_error(run_command("loops", "scans", "--out", "found", *arguments), words)


def test_paths_that_are_not_utf_8_survive(tmp_path):
    command = parsed("segment", "--data", "n\udcff", "--out", "maps")
    assert parsed("segment", "--config", record_command(command, tmp_path)) == command


def test_a_flag_sets_the_backbone_of_the_preset_and_flags_of_other_backbones_are_unknown():
    swin = parsed("train", "--preset", "paper", "--model.backbone.window", "4").config.model
    assert (swin.backbone.kind, swin.backbone.window, swin.backbone.patch) == ("swin", 4, 4)
    ended = run_command("train", "--preset", "paper", "--model.backbone.stem.average", "4")
    assert_one_line_error(ended, "found '--model.backbone.stem.average'")


def test_every_command_has_a_script_and_an_entry_point():
    scripts = {path.name: path.read_text() for path in (ROOT / "bin").iterdir() if path.stat().st_mode & 0o111}
    assert scripts.keys() == COMMANDS.keys() | {"_command", "_python", "docs", "test"}
    for name in COMMANDS:
        assert scripts[name].splitlines()[-1].endswith(f'/_command" {name} "$@"') and all(load_command(name))
    installed = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    assert installed == {f"sglpr-{name}": "sglpr_jax.cli.__main__:main" for name in COMMANDS}
