"""The names of all methods, for whoever must know them before the methods themselves are imported."""

from typing import TYPE_CHECKING, Literal

NETWORK = "sglpr"
HANDCRAFTED_NAMES = (
    "scan-context",
    "m2dp",
    "lidar-iris",
    "ssc",
    "ssc-24",
    "solid",
    "polar-fft",
    "thumbnail",
    "random",
)
METHODS = (NETWORK, *HANDCRAFTED_NAMES)
"""The names of all methods."""

if TYPE_CHECKING:
    MethodName = str
else:
    MethodName = Literal[METHODS]
"""One of `METHODS`: a command line lists them in its help and refuses others."""
