"""What starts quickly does not import what takes long: JAX alone takes most of a second."""

import subprocess
import sys

import numpy as np

SLOW = ("jax", "flax", "numpy", "jaxtyping")


def imported_by(program: str, *, of: tuple[str, ...] = SLOW) -> set[str]:
    """Which of these modules a Python of its own has imported at the end of the program."""
    program += f"\nimport sys; print('imported', *(name for name in {of} if name in sys.modules))"
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr
    return set(ended.stdout.splitlines()[-1].split()[1:])


def test_imports_help_and_wrong_flags_of_the_commands_bring_nothing_slow():
    """One process for all: the first command after which a slow module is there is named."""
    program = f"""
import importlib, sys
def check(after):
    found = [name for name in {SLOW} if name in sys.modules]
    assert not found, (after, found)
for module in "sglpr_jax", "sglpr_jax.data", "sglpr_jax.sim":
    importlib.import_module(module)
    check(module)
from sglpr_jax.cli.__main__ import COMMANDS, main
for command in COMMANDS:
    for flag, status in ("--help", 0), ("--no-such-flag", 2):
        sys.argv = ["sglpr_jax.cli", command, flag]
        try:
            main()
        except SystemExit as ended:
            assert ended.code == status, (command, flag, ended.code)
        else:
            raise AssertionError(f"expected {{command}} to exit")
    check(command)
"""
    assert imported_by(program) == set()


def test_a_folder_of_scans_is_opened_without_scipy_and_without_the_simulator(tmp_path):
    points = np.random.default_rng(0).uniform(0, 1, (500, 4)).astype("<f4") * [20, 20, 2, 1]
    points.astype("<f4").tofile(tmp_path / "000000.bin")
    program = f"""
from pathlib import Path
from sglpr_jax.cli.recording import RecordingOptions
assert len(RecordingOptions(sensor_height=1.7).open(Path({str(tmp_path)!r}))) == 1
"""
    assert imported_by(program, of=("scipy", "sglpr_jax.sim.dataset")) == set()
