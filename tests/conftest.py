"""Test-wide settings: strict ranks, compiled programs that are kept, and where the development data lies."""

import contextlib
import os
import resource
from pathlib import Path

import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest

from sglpr_jax.models.config import ModelConfig
from sglpr_jax.models.params import Params
from sglpr_jax.models.sglpr import init

jax.config.update("jax_numpy_rank_promotion", "raise")

COMPILED = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "sglpr-jax-tests"
"""Two thirds of the suite's time is XLA's: what it has compiled is kept, for all workers and for the next time."""
KEPT_FROM_S = 0.2
jax.config.update("jax_compilation_cache_dir", str(COMPILED))
jax.config.update("jax_persistent_cache_min_compile_time_secs", KEPT_FROM_S)
os.environ |= {  # for the processes that tests start
    "JAX_COMPILATION_CACHE_DIR": str(COMPILED),
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": str(KEPT_FROM_S),
}

TESTS = Path(__file__).resolve().parent
QUICKLY = (
    "benchmark_programs/test_gpu.py",
    "benchmark_programs/test_speed.py",
    "cli/",
    "docs/",
    "training/",
    "test_wheel.py",
)
"""What is tested there is what is done with numbers: XLA need not optimize, which halves the time that it takes. The
numbers themselves are tested elsewhere, of programs compiled as users' are."""


@pytest.hookimpl(tryfirst=True)  # before fixtures of any scope compile
def pytest_runtest_setup(item):
    where = item.path.relative_to(TESTS).as_posix()
    quickly = where.startswith(QUICKLY) and "loops" not in where  # their programs run for longer than they compile
    jax.config.update("jax_disable_most_optimizations", quickly)
    os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = str(int(quickly))


SHARED = TESTS.parents[1] / "shared"


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of development data; real scans may not be redistributed, so a clone does not have it."""
    if not SHARED.is_dir():
        pytest.skip(f"no development data at {SHARED} (licences forbid shipping it)")
    return SHARED


@pytest.fixture(scope="module", autouse=True)
def _free_compiled_programs():
    """No test file needs the programs that another one compiled: kept, they grow to gigabytes."""
    yield
    jax.clear_caches()


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
    """Without the checks of types, which tests alone have: a wrong word comes as far as a user's does."""
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
