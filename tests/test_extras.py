import shlex
import sys
import tomllib
from pathlib import Path

import pytest

from sglpr_jax.extras import install_command

PROJECT = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]


@pytest.mark.parametrize("extra", sorted(set(PROJECT["optional-dependencies"]) - {"dev"}))
def test_the_command_installs_the_packages_of_an_extra_on_the_platforms_that_have_them(extra):
    words = shlex.split(install_command(extra))
    assert words[:4] == [sys.executable, "-m", "pip", "install"]

    def parts(requirement: str) -> tuple[str, str]:
        package, _, platforms = requirement.replace('"', "'").partition(";")
        return package.lower(), platforms.strip(" ()")

    expected = PROJECT["optional-dependencies"][extra]
    assert sorted(map(parts, words[4:])) == sorted(map(parts, expected))
