"""`describe` without tracing it again: what an earlier process traced lies beside what JAX keeps of its compilations.

Of a command that describes one scan, tracing the network and lowering it took a quarter of the time.
"""

import contextlib
import functools
import hashlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

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
_programs: dict[tuple[ModelConfig, tuple[Any, ...]], Callable[..., Array]] = {}
"""Of this process, by the model and the shapes of its images."""


def kept_describe(params: Params) -> Callable[..., Float[Array, "*b d"]]:
    """Return `describe` by these weights: a function of images and, where the model reads them, of labels.

    Where JAX has a compilation cache, the traced program is kept in it for the next process; a program of other code,
    of another JAX or of another model is never used, nor is a damaged one. Without a cache it is `describe` itself.
    """
    if jax.config.jax_compilation_cache_dir is None:
        return functools.partial(describe, params)
    folder = Path(jax.config.jax_compilation_cache_dir) / "traced"

    def describe_images(*images: Any) -> Float[Array, "*b d"]:
        shapes = jax.tree.map(jax.typeof, images)
        if (params.config, shapes) not in _programs:
            _programs[params.config, shapes] = jax.jit(_program(params, shapes, folder).call)
        return _programs[params.config, shapes](params.weights, *images)

    return describe_images


def _program(params: Params, shapes: tuple[Any, ...], folder: Path) -> jax.export.Exported:
    """The program for images of these shapes: read, or traced and written where that is possible."""
    file = folder / f"{_name(params.config, shapes)}.stablehlo"
    kept = _read(file)
    if kept is not None:
        return kept

    @jax.jit
    def of_weights(weights: Any, *images: Any) -> Array:
        return describe(Params(weights, params.config), *images)

    with without_source_locations():
        traced = jax.export.export(of_weights)(jax.tree.map(jax.typeof, params.weights), *shapes)
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


def _name(config: ModelConfig, shapes: tuple[Any, ...]) -> str:
    """What a program depends on; of the code what Python looks at, too, before it uses what it compiled."""
    code = [(str(file), file.stat().st_size, file.stat().st_mtime_ns) for file in sorted(PACKAGE.rglob("*.py"))]
    settings = [getattr(jax.config, name) for name in _SETTINGS]
    about = (jax.__version__, jaxlib.version.__version__, jax.default_backend(), settings, config, shapes, code)
    return hashlib.sha256(repr(about).encode()).hexdigest()


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
