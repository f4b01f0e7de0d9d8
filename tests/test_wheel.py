"""What `pip install` gives works without the checkout, and speaks of its commands by the names that it installs."""

import os
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow
ROOT = Path(__file__).resolve().parents[1]
TIMEOUT_S = 600


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """Runs the commands of a wheel in an environment of its own, far from the checkout.

    The dependencies are those of this environment: its folder is added to the path, without the link to the checkout,
    which only the environment's own start would follow. `sglpr-embed` compiles as it does for a user, with all
    optimizations, the other commands as in the tests.
    """
    folder = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "-w", folder, ROOT]
    subprocess.run(build, check=True, timeout=TIMEOUT_S)
    (wheel,) = folder.glob("*.whl")
    venv.create(folder / "venv", with_pip=False)
    paths = sysconfig.get_paths(vars={"base": str(folder / "venv"), "platbase": str(folder / "venv")}, scheme="venv")
    install = [sys.executable, "-m", "pip", "--python", folder / "venv", "install", "--quiet", "--no-deps", wheel]
    subprocess.run(install, check=True, timeout=TIMEOUT_S)
    (Path(paths["purelib"]) / "dependencies.pth").write_text(sysconfig.get_paths()["purelib"] + "\n")
    work = tmp_path_factory.mktemp("work")
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    environment |= {"JAX_PLATFORMS": "cpu", "XDG_CACHE_HOME": str(work / "cache")}
    quickly = {"XLA_FLAGS", "JAX_DISABLE_MOST_OPTIMIZATIONS"}
    as_users = {name: value for name, value in environment.items() if name not in quickly}

    def run(program: str, *arguments: object) -> subprocess.CompletedProcess:
        command = [Path(paths["scripts"]) / program, *map(str, arguments)]
        env = as_users if program == "sglpr-embed" else environment
        return subprocess.run(command, cwd=work, env=env, capture_output=True, text=True, timeout=TIMEOUT_S)

    return run


def test_the_package_and_its_help_are_the_wheel_s(installed):
    ended = installed("python", "-c", "import sglpr_jax; print(sglpr_jax.__file__, sglpr_jax.shipped_weights())")
    assert str(ROOT) not in ended.stdout and "site-packages" in ended.stdout, ended.stdout + ended.stderr
    assert "'sglpr', 'sglpr-small'" in ended.stdout
    help = installed("sglpr-embed", "--help").stdout
    assert "sglpr-embed" in help and "bin/" not in help


def test_the_whole_job_without_the_checkout(installed):
    """Simulate, embed, evaluate."""
    for command in (
        ("sglpr-simulate", "--out", "town", "--seq", "08", "--scans", 12, "--azimuth-steps", 60),
        ("sglpr-embed", "--weights", "sglpr-small", "--data", "town", "--seq", "08", "--out", "08.npz"),
        ("sglpr-evaluate", "08.npz", "--protocol", "pairs-f1max"),
    ):
        ended = installed(*command)
        assert ended.returncode == 0, ended.stderr
    refused = installed("sglpr-evaluate", "08.npz", "--database", "08.npy")
    assert refused.returncode == 1 and "expected descriptor files of sglpr-embed (.npz)" in refused.stderr
