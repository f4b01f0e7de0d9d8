"""What a backbone is: a configuration, and two calls, from an image to features and back to pixels.

A backbone is two files of this folder: NAME_config.py has a frozen configuration with what `BackboneConfig` lists, and
imports no JAX, so that a command line can name its fields at once; NAME.py a class with the two calls of `Backbone`.
`models/config.py` names the configuration in its union, `build.py` the class, and nothing else has to know of them.
"""

from collections.abc import Mapping
from typing import NamedTuple, Protocol, runtime_checkable

from jaxtyping import Array, Float


class Seen(NamedTuple):
    """What a backbone makes of images."""

    features: Float[Array, "b p q c"]
    """What the place head reads, and what the decoder begins with."""
    finer: list[Array]
    """The maps on the way that the decoder looks at again, finest first."""
    named: dict[str, Array]
    """Every map by name, for pictures and tests."""


@runtime_checkable
class Backbone(Protocol):
    """The layers. They belong to the Flax module in whose `__call__` they are called, and are named there."""

    def __call__(self, image: Float[Array, "b p q c"], *, train: bool) -> Seen:
        """The features of images; `train` switches stochastic depth on."""
        ...

    def decode(self, seen: Seen) -> Float[Array, "b _ _ _"]:
        """The pixels that the segmentation head reads, and a place head with the tap `pixels`. Call it once."""
        ...


@runtime_checkable
class BackboneConfig(Protocol):
    """A backbone as plain values. All sizes are in pixels of the image that the backbone sees: rows, columns."""

    @property
    def kind(self) -> str:
        """Its name, by which config.json tells one backbone from another."""
        ...

    @property
    def token(self) -> tuple[int, int]:
        """How large a patch of the image one of the features stands for."""
        ...

    @property
    def width(self) -> int:
        """Channels of the features."""
        ...

    @property
    def multiple(self) -> tuple[int, int]:
        """The image's size must be a multiple of this."""
        ...

    @property
    def needs_polar(self) -> bool:
        """Whether it works on a polar image only."""
        ...

    @property
    def pictures(self) -> Mapping[str, str]:
        """Of which maps heat maps are drawn: what a picture is called, and the map's name in `Seen.named`."""
        ...
