"""The table of commands agrees with `bin/` and with the names that `pip install` makes."""

import tomllib
from pathlib import Path

from sglpr_jax.cli.__main__ import COMMANDS, load_command

ROOT = Path(__file__).resolve().parents[2]


def test_every_command_has_a_script_and_an_entry_point():
    scripts = {path.name: path.read_text() for path in (ROOT / "bin").iterdir() if path.stat().st_mode & 0o111}
    assert scripts.keys() == COMMANDS.keys() | {"_command", "_python", "docs", "test"}
    for name in COMMANDS:
        assert scripts[name].splitlines()[-1].endswith(f'/_command" {name} "$@"') and all(load_command(name))
    installed = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    assert installed == {f"sglpr-{name}": "sglpr_jax.cli.__main__:main" for name in COMMANDS}
