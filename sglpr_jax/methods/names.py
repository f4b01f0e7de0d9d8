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
UNTRAINED, SHIPPED = "untrained", "shipped"
"""Beside a network just trained: the same with fresh weights, and the weights that describe where none are named."""
BESIDE = (UNTRAINED, "thumbnail", "polar-fft")
"""The methods that stand beside a network just trained, where none are named."""

if TYPE_CHECKING:
    MethodName = BesideName = str
else:
    MethodName = Literal[METHODS]
    BesideName = Literal[(UNTRAINED, SHIPPED, *HANDCRAFTED_NAMES)]
"""One of these names: a command line lists them in its help and refuses others."""
