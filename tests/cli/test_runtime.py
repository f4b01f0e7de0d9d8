"""Names of commands in messages, bounds of flags, and one-line errors of all commands."""

import dataclasses
import os
import subprocess
import sys
from pathlib import Path

import jax
import pytest

import sglpr_jax
from sglpr_jax.cli import runtime
from sglpr_jax.cli.runtime import parse_command, with_installed_names
from sglpr_jax.fields import NotNegative, Size


@dataclasses.dataclass(frozen=True)
class Example:
    """A command."""

    batch: Size = 8
    spacing_m: NotNegative | None = None
    seed: int = 0


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("bin/embed, then bin/evaluate.", "sglpr-embed, then sglpr-evaluate."),
        ("(of bin/map: --pose-format)", "(of sglpr-map: --pose-format)"),
        *((path, path) for path in ("/me/bin/scans/08.npz", "bin/scans/08.npz", "bin/map.safetensors", "my-bin/embed")),
        ("bin/test", "bin/test"),
    ],
)
def test_names_of_commands_are_those_of_the_installation_and_paths_are_unchanged(text, expected, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["/home/me/.local/bin/sglpr-evaluate", "08.npz"])
    assert with_installed_names(text) == expected


@pytest.mark.parametrize(
    ("flags", "error"),
    [
        (("--batch", "0"), "--batch: expected a number from 1 up to 1048576, found 0"),
        (("--spacing-m", "-0.5"), "--spacing-m: expected a number from 0, found -0.5"),
        (("--spacing-m", "nan"), "--spacing-m: expected a finite number, found nan"),
    ],
)
def test_numbers_outside_the_bounds_of_a_flag_are_errors(flags, error):
    with pytest.raises(ValueError) as raised:
        parse_command(Example, "example", list(flags))
    assert str(raised.value) == error


def python(work: str, *, shell: str = "", **environment: str) -> subprocess.CompletedProcess[str]:
    """Run a command whose work is an expression, in a Python of its own."""
    program = f"from sglpr_jax.cli.runtime import run; run(lambda: None, lambda command: {work})"
    path = {"PYTHONPATH": str(Path(sglpr_jax.__file__).parents[1]), "PYTHONUNBUFFERED": ""}
    code = ["bash", "-c", f'"$0" -c "$1" {shell}; echo status ${{PIPESTATUS[0]}} >&2', sys.executable, program]
    return subprocess.run(code, capture_output=True, text=True, env=os.environ | path | environment, timeout=120)


def test_a_reader_that_ends_early_ends_the_command_without_a_message():
    ended = python("[print(number) for number in range(100_000)]", shell="| head -1")
    assert ended.stdout == "0\n" and ended.stderr == "status 141\n"


def test_output_that_is_not_utf_8_is_escaped():
    assert python("print('n\\udcff')", LANG="C.UTF-8").stdout == "n\\udcff\n"


@pytest.mark.slow
def test_a_device_that_is_absent_is_one_line():
    ended = python("[].append(__import__('jax').devices())", JAX_PLATFORMS="nosuch")
    assert ended.stderr.startswith("error: JAX_PLATFORMS=nosuch: expected a device that JAX finds, found none (")
    assert ended.stderr.endswith("\nstatus 1\n") and ended.stderr.count("\n") == 2


@pytest.mark.parametrize(("text", "found"), [("a\x1b[2J\nb", "error: a\\x1b[2J b"), ("x" * 2**20, None)])
def test_an_error_is_one_line_of_limited_length(text, found):
    def work(command):
        raise ValueError(text)

    with pytest.raises(SystemExit) as ended:
        runtime.run(lambda: None, work)
    assert isinstance(ended.value.code, str) and len(ended.value.code) < 2100
    assert found is None or ended.value.code == found


def test_the_first_start_says_that_it_compiles_and_the_next_does_not(tmp_path, capsys):
    runtime._announce_first_compilation(tmp_path / "compiled")
    assert not capsys.readouterr().err
    for _ in range(2):
        jax.monitoring.record_event(runtime.COMPILATION)
    assert capsys.readouterr().err.count("first start: compiling for this computer") == 1
    (tmp_path / "program").touch()
    runtime._announce_first_compilation(tmp_path)
    jax.monitoring.record_event(runtime.COMPILATION)
    assert not capsys.readouterr().err
