"""Methods that tables 1 to 3 compare with the trained variants: handcrafted methods, and weights."""

from pathlib import Path

from sglpr_jax.methods.handcrafted import HANDCRAFTED
from sglpr_jax.methods.learned import LEARNED
from sglpr_jax.methods.learned.weights_file import method_of
from sglpr_jax.methods.method import Takes


def content_of(method: str) -> Takes:
    """Return what a handcrafted method or weights need in a recording. `method` is a name or a folder of weights."""
    if method in HANDCRAFTED:
        return HANDCRAFTED[method].takes
    learned = method_of(Path(method))
    return LEARNED[learned].takes if learned in LEARNED else "images"
