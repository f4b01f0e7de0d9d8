"""Commands are called as whoever started one knows them; what is a path stays one."""

import dataclasses
import sys

import pytest

from sglpr_jax.cli.runtime import own_names, parse_command
from sglpr_jax.fields import NotNegative, Size


@dataclasses.dataclass(frozen=True)
class Example:
    """A command."""

    batch: Size = 8
    spacing_m: NotNegative | None = None
    seed: int = 0


@pytest.fixture
def installed(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["/home/me/.local/bin/sglpr-evaluate", "08.npz"])


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("bin/embed, then bin/evaluate.", "sglpr-embed, then sglpr-evaluate."),
        ("for `bin/train --weights`", "for `sglpr-train --weights`"),
        ("(of bin/map: --pose-format)", "(of sglpr-map: --pose-format)"),
    ],
)
def test_commands_have_the_names_that_are_installed(installed, text, expected):
    assert own_names(text) == expected


@pytest.mark.parametrize(
    "path",
    [
        "/home/me/bin/scans/08.npz",
        "/home/me/bin/embed",
        "~/bin/embed",
        "../bin/embed",
        "bin/scans/08.npz",
        "bin/map/08.npz",
        "bin/map.safetensors",
        "bin/map-2",
        "my-bin/embed",
        "bin/test",
    ],
)
def test_paths_and_other_names_stay(installed, path):
    assert own_names(f"error: {path}: expected a descriptor file") == f"error: {path}: expected a descriptor file"


def test_a_command_of_the_checkout_keeps_its_name(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["/home/me/sglpr-jax/bin/evaluate"])
    assert own_names("bin/embed, then bin/evaluate") == "bin/embed, then bin/evaluate"


@pytest.mark.parametrize(
    ("flags", "error"),
    [
        (("--batch", "0"), "--batch: expected a number from 1 up to 1048576, found 0"),
        (("--batch", "-1"), "--batch: expected a number from 1 up to 1048576, found -1"),
        (("--spacing-m", "-0.5"), "--spacing-m: expected a number from 0, found -0.5"),
        (("--spacing-m", "nan"), "--spacing-m: expected a finite number, found nan"),
    ],
)
def test_numbers_that_no_flag_can_have_are_told(flags, error):
    with pytest.raises(ValueError) as raised:
        parse_command(Example, "example", list(flags))
    assert str(raised.value) == error


def test_all_other_numbers_are_taken():
    assert parse_command(Example, "example", ["--spacing-m", "0", "--seed", "-3"]) == Example(8, 0.0, -3)
