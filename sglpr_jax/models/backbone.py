"""Interface of a backbone: a configuration, and two calls, from images to features and back to pixels.

A backbone consists of two files in this folder. NAME_config.py has a frozen configuration with the properties of
`BackboneConfig`. It imports no JAX, so a command line can list its fields quickly. NAME.py has a class with the two
calls of `Backbone`.

To add a backbone, add its configuration to the union in `config.py` and its class to `build.py`. No other code
depends on it.
"""

from collections.abc import Mapping
from typing import NamedTuple, Protocol, runtime_checkable

from jaxtyping import Array, Float


class Seen(NamedTuple):
    """Output of a backbone for a batch of images."""

    features: Float[Array, "b p q c"]
    """Input of the place head and of the decoder."""
    finer: list[Array]
    """Intermediate maps that the decoder uses again, finest first."""
    named: dict[str, Array]
    """All maps by name, for pictures and tests."""


@runtime_checkable
class Backbone(Protocol):
    """Layers of a backbone. They belong to the Flax module that calls them, and get their names there."""

    def __call__(self, image: Float[Array, "b p q c"], *, train: bool) -> Seen:
        """Computes the features of images. `train` enables stochastic depth."""
        ...

    def decode(self, seen: Seen) -> Float[Array, "b _ _ _"]:
        """Computes pixels for the segmentation head and for a place head with the tap `pixels`. Call it only once."""
        ...


@runtime_checkable
class BackboneConfig(Protocol):
    """Configuration of a backbone. All sizes are (rows, columns) in pixels of the image that the backbone sees."""

    @property
    def kind(self) -> str:
        """Name that identifies the backbone in config.json."""
        ...

    @property
    def token(self) -> tuple[int, int]:
        """Size of the image patch that one feature represents."""
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
        """Whether the backbone requires a polar image."""
        ...

    @property
    def pictures(self) -> Mapping[str, str]:
        """Maps to draw as heat maps: from the title of each picture to the name of its map in `Seen.named`."""
        ...
