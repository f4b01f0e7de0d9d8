"""`describe` without tracing it again: what an earlier process traced lies beside what JAX keeps of its compilations.

Of a command that describes one scan, tracing the network and lowering it took a quarter of the time.
"""

import contextlib
import functools
import hashlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import flax
import jax
import jax.export
import jaxlib.version
from jaxtyping import Array, Float

from sglpr_jax.files import replacing
from sglpr_jax.models.config import ModelConfig
from sglpr_jax.models.params import Params
from sglpr_jax.models.sglpr import describe

PACKAGE = Path(__file__).resolve().parents[1]
_SETTINGS = ("jax_enable_x64", "jax_default_matmul_precision", "jax_numpy_dtype_promotion")
"""Of JAX, those that change what is traced."""
_programs: dict[tuple[Any, ...], Callable[..., Array]] = {}
"""Of this process, by what they are made for: a model, the types of its weights and images, and settings."""


def kept_describe(params: Params) -> Callable[..., Float[Array, "*b d"]]:
    """Return `describe` by these weights: a function of images and, where the model reads them, of labels.

    Where JAX keeps what it compiles in a folder, the traced program is kept there for the next process; a program of
    other code, of another JAX or of another model is never used, nor is a damaged one. It is to be called as it is, not
    under vmap or grad. Elsewhere it is `describe` itself.
    """
    folder = _folder()
    if folder is None:
        return functools.partial(describe, params)

    def describe_images(*images: Any) -> Float[Array, "*b d"]:
        arguments = jax.tree.map(jax.typeof, (params.weights, *images))
        made_for = (params.config, tuple(jax.tree.leaves(arguments)), _settings())
        if made_for not in _programs:
            file = folder / f"{_name(made_for)}.stablehlo"
            _programs[made_for] = jax.jit(_program(params.config, arguments, file).call)
        return _programs[made_for](params.weights, *images)

    return describe_images


def _folder() -> Path | None:
    """Where programs are kept; None where JAX keeps none, or not in a folder of this machine."""
    folder, kept = (
        getattr(jax.config, f"jax_{name}") for name in ("compilation_cache_dir", "enable_compilation_cache")
    )
    return Path(folder) / "traced" if kept and folder and "://" not in folder else None


def _program(config: ModelConfig, arguments: tuple[Any, ...], file: Path) -> jax.export.Exported:
    """The program for weights and images of these shapes: read, or traced and written where that is possible."""
    kept = _read(file)
    if kept is not None:
        return kept

    @jax.jit
    def of_weights(weights: Any, *images: Any) -> Array:
        return describe(Params(weights, config), *images)

    with without_source_locations():
        traced = jax.export.export(of_weights)(*arguments)
    _write(file, bytes(traced.serialize()))
    return traced


@contextlib.contextmanager
def without_source_locations() -> Iterator[None]:
    """Leave out of programs where the files of their author lie: smaller ones, and the same bytes anywhere."""
    limit = "jax_traceback_in_locations_limit"
    before = getattr(jax.config, limit)
    jax.config.update(limit, 0)
    try:
        yield
    finally:
        jax.config.update(limit, before)


def _settings() -> tuple[Any, ...]:
    """What JAX is told to do, as far as it changes what is traced."""
    return tuple(getattr(jax.config, name) for name in _SETTINGS)


def _name(made_for: tuple[Any, ...]) -> str:
    """A name for all that a program depends on; of the code what Python looks at, too, before it uses a .pyc file."""
    code = [(str(file), file.stat().st_size, file.stat().st_mtime_ns) for file in sorted(PACKAGE.rglob("*.py"))]
    versions = (jax.__version__, jaxlib.version.__version__, flax.__version__)
    return hashlib.sha256(repr((versions, jax.default_backend(), made_for, code)).encode()).hexdigest()


def _read(file: Path) -> jax.export.Exported | None:
    """The program of a file; None where there is none, or where it is not as it was written."""
    try:
        checksum, program = (content := file.read_bytes())[:32], content[32:]
    except OSError:
        return None
    return jax.export.deserialize(bytearray(program)) if hashlib.sha256(program).digest() == checksum else None


def _write(file: Path, program: bytes) -> None:
    """Keep a program. Where that is impossible, the next process traces again, and that is all."""
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with replacing(file) as temporary:
            temporary.write_bytes(hashlib.sha256(program).digest() + program)
    except OSError:
        pass
