"""Test-wide settings: strict ranks, compiled programs that are kept, and where the development data lies."""

import contextlib
import os
import resource
import tempfile
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest
from filelock import FileLock

from sglpr_jax import progress
from sglpr_jax.models.config import ModelConfig
from sglpr_jax.models.sglpr import init
from sglpr_jax.models.weights import Params

jax.config.update("jax_numpy_rank_promotion", "raise")
progress.PLAIN_EVERY_S = float("inf")  # a test on a busy machine takes longer than one line of progress

HOME = os.path.expanduser("~")
if HOME == "~":  # a user without a home folder
    HOME = f"{tempfile.gettempdir()}/home-{os.getuid()}"
COMPILED = Path(os.environ.get("XDG_CACHE_HOME") or f"{HOME}/.cache") / "sglpr-jax-tests"
"""Compiled programs, kept for all workers and for the next run. Small ones too: tests call thousands of them."""
KEPT = {"JAX_COMPILATION_CACHE_DIR": str(COMPILED), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
jax.config.update("jax_compilation_cache_dir", str(COMPILED))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
COMPILE = "--xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1"
"""XLA's older code generator, on one thread: it compiles a training step in less than half the time."""
os.environ |= KEPT | {"XLA_FLAGS": f"{COMPILE} {os.environ.get('XLA_FLAGS', '')}"}  # for the processes tests start, too

TESTS = Path(__file__).resolve().parent
RUN_LONG = (
    "cli/test_live",
    "cli/test_loops",
    "cli/test_map.py",
    "cli/test_survival.py",
    "docs/test_blocks.py::test_python_runs[README.md]",
    "docs/test_blocks.py::test_python_runs[docs/guides/loops.md]",
    "docs/test_blocks.py::test_python_runs[docs/guides/maps.md]",
    "docs/test_blocks.py::test_python_runs[docs/guides/sessions.md]",
    "live/test_live_map.py",
    "loops/",
    "maps/",
    "odometry/",
    "pose_graph/",
    "registration/",
    "sim/",
)
"""Tests whose programs run for longer than they compile: XLA optimizes them. It compiles the other programs without
optimizing, in a fifth of the time."""
AS_USERS_DO = ("models/test_shipped.py",)
"""Optimized, too: descriptors of the shipped weights."""
AS_INSTALLED = ("benchmark_programs/", "cli/", "docs/")
"""Tests that run whole programs as users do, without the type checks that the tests of the library have."""
MOST_GROWTH = 1.5e9
"""Bytes by which a process may grow before JAX's compiled programs are freed (again)."""


@pytest.hookimpl(tryfirst=True)  # before fixtures of any scope compile
def pytest_runtest_setup(item):
    where = item.nodeid.removeprefix(f"{TESTS.name}/")
    quickly = not where.startswith(RUN_LONG + AS_USERS_DO)
    if os.environ.get("JAX_DISABLE_MOST_OPTIMIZATIONS") != str(int(quickly)):
        jax.clear_caches()  # of programs compiled the other way
        jax.config.update("jax_disable_most_optimizations", quickly)
        os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = str(int(quickly))
    whole = where.startswith(RUN_LONG) and item.get_closest_marker("slow") is not None  # searches of whole drives
    jaxtyping.config.update("jaxtyping_disable", whole or where.startswith(AS_INSTALLED))


SHARED = TESTS.parents[1] / "shared"


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of development data; real scans may not be redistributed, so a clone does not have it."""
    if not SHARED.is_dir():
        pytest.skip(f"no development data at {SHARED} (licences forbid shipping it)")
    return SHARED


@pytest.fixture(scope="session")
def once(tmp_path_factory) -> Callable[[str, Callable[[Path], object]], Path]:
    """`once(name, make)` returns a folder that `make(folder)` fills once for all workers of a run. No test changes
    it."""

    def made(name: str, make: Callable[[Path], object]) -> Path:
        base = tmp_path_factory.getbasetemp()
        base = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
        folder, whole = base / name, base / f"{name}.whole"
        with FileLock(base / f"{name}.lock"):
            if not whole.exists():
                make(folder)
                whole.touch()
        return folder

    return made


_freed_at = [0.0]


def _resident_bytes() -> float:
    """Return the memory of this process; infinite if the system does not tell."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()
    except FileNotFoundError:
        return float("inf")


@pytest.fixture(scope="module", autouse=True)
def _bounded_memory():
    """Free compiled programs once they have grown to gigabytes; until then the next test files use them again."""
    yield
    if _resident_bytes() > _freed_at[0] + MOST_GROWTH:
        jax.clear_caches()
        _freed_at[0] = min(_resident_bytes(), MOST_GROWTH)


@pytest.fixture
def small_files():
    """`with small_files(size):` the system lets no file of this process grow beyond that many bytes. It may
    afterwards, because pytest's own output may go to a file."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)

    @contextlib.contextmanager
    def limited(size):
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)

    return limited


@pytest.fixture
def as_installed():
    """No type checks, which only tests have: a wrong word gets as far as a user's does."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.fixture(scope="session")
def random_params():
    """Weights of a model that tell images apart; made by numpy, for compiling the model's `init` takes seconds."""

    def make(config: ModelConfig) -> Params:
        rng = np.random.default_rng(0)
        shapes = jax.eval_shape(lambda: init(jax.random.key(0), config=config))

        def draw(path, leaf) -> jax.Array:
            inputs = np.prod(leaf.shape[:-1])
            values = rng.normal(scale=inputs**-0.5 if inputs > 1 else 0.1, size=leaf.shape)
            return jnp.asarray(values + (path[-1].key == "scale"), leaf.dtype)

        return Params(jax.tree_util.tree_map_with_path(draw, shapes.weights), config)

    return make
