"""Sceneries of towns: types of neighbourhoods, uniformity of the streets, and hills."""

import dataclasses
from collections.abc import Mapping

from sglpr_jax.sim.styles import STYLES
from sglpr_jax.sim.things import Range


@dataclasses.dataclass(frozen=True)
class Scenery:
    """Parameters of a random town. Pairs are ranges."""

    styles: Mapping[str, float]
    """Relative frequencies of `STYLES` in new neighbourhoods. Where the vehicle drives fast, there is a highway."""
    look_alike: float = 0.12
    """Fraction of the stretches that are long and uniform."""
    crossing_every_m: Range = (60.0, 150.0)
    """Distance from one side street to the next, in metres."""
    wavelength_m: Range = (150.0, 600.0)
    """Wavelength of the hills, in metres."""
    steepest: float = 0.05
    """Maximum slope of the hills. A value of 0.05 is 5 %."""

    def __post_init__(self):
        unknown = [name for name in self.styles if name not in STYLES]
        if unknown or sum(self.styles.values()) <= 0:
            raise ValueError(f"styles: expected shares of {', '.join(STYLES)}, found {dict(self.styles)}")


TOWN = Scenery(
    {"centre": 0.33, "suburb": 0.33, "estate": 0.09, "works": 0.04, "park": 0.08, "square": 0.02, "country": 0.11}
)
OUTSKIRTS = Scenery(
    {
        "walled": 0.25,
        "hillside": 0.25,
        "country": 0.15,
        "suburb": 0.15,
        "works": 0.08,
        "estate": 0.07,
        "centre": 0.05,
    },
    look_alike=0.3,
    crossing_every_m=(100.0, 300.0),
    wavelength_m=(60.0, 400.0),
    steepest=0.09,
)
"""Hilly land with long roads between walls, hedges and slopes, where neighbouring places look alike."""
LANES = Scenery(
    {"hedged": 0.45, "hillside": 0.2, "country": 0.1, "suburb": 0.15, "walled": 0.1},
    look_alike=0.3,
    crossing_every_m=(80.0, 250.0),
    wavelength_m=(80.0, 500.0),
    steepest=0.07,
)
"""Roads between overgrown hedges. One lane sees the face of a hedge, the other lane its depth."""
GARDENS = Scenery({"gardens": 0.6, "centre": 0.15, "suburb": 0.1, "estate": 0.05, "park": 0.05, "country": 0.05})
"""Streets of houses with front gardens: low see-through fences, hedges cut like walls, and old trees."""
SCENERIES = {"town": TOWN, "outskirts": OUTSKIRTS, "lanes": LANES, "gardens": GARDENS}
"""Sceneries by their names on the command line."""
