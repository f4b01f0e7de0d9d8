"""What starts quickly does not import what takes long: JAX alone takes most of a second."""

import subprocess
import sys

import pytest

SLOW = ("jax", "flax", "numpy", "jaxtyping")
QUICK = (
    "convert",
    "demo",
    "embed",
    "evaluate",
    "export",
    "loops",
    "map",
    "relocalize",
    "segment",
    "simulate",
    "stress",
)
"""Commands whose --help does not wait for JAX."""


def imported_by(program: str) -> set[str]:
    """Which of the slow packages a Python of its own has imported at the end of the program."""
    program += f"\nimport sys; print('imported', *(name for name in {SLOW} if name in sys.modules))"
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    return set(ended.stdout.splitlines()[-1].split()[1:])


@pytest.mark.parametrize("module", ["sglpr_jax", "sglpr_jax.data", *(f"sglpr_jax.cli.{name}" for name in QUICK)])
def test_an_import_brings_nothing_slow(module):
    assert imported_by(f"import {module}") == set()


def test_a_name_of_the_library_brings_what_it_needs():
    assert imported_by("import sglpr_jax; sglpr_jax.CATEGORIES") == {"numpy", "jaxtyping"}
    assert "jax" in imported_by("import sglpr_jax; sglpr_jax.describe")


@pytest.mark.parametrize("command", QUICK)
@pytest.mark.parametrize("flags", ["'--help'", "'--no-such-flag'"])
def test_help_and_wrong_flags_do_not_wait_for_jax(command, flags):
    program = f"""
import sys
from sglpr_jax.cli.{command} import main
sys.argv = ["{command}", {flags}]
try:
    main()
except SystemExit as ended:
    assert ended.code == (0 if "--help" in sys.argv else 2), ended.code
else:
    raise AssertionError("expected main() to exit")
"""
    assert imported_by(program) == set()
