"""What kind of land a town lies in: which neighbourhoods it has, how alike its streets are, how steep its hills."""

import dataclasses
from collections.abc import Mapping

from sglpr_jax.sim.styles import STYLES
from sglpr_jax.sim.things import Range


@dataclasses.dataclass(frozen=True)
class Scenery:
    """What a town is drawn from; pairs are ranges."""

    styles: Mapping[str, float]
    """How often each of `STYLES` begins a new neighbourhood; a highway is where the vehicle drives fast."""
    look_alike: float = 0.12
    """Share of the stretches that are long and all alike."""
    crossing_every_m: Range = (60.0, 150.0)
    """From one side street to the next."""
    wavelength_m: Range = (150.0, 600.0)
    """Of the hills."""
    steepest: float = 0.05
    """No hill has a greater slope."""

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
"""Hilly land with long roads between walls, hedges and slopes, where one place looks like the next."""
LANES = Scenery(
    {"hedged": 0.45, "hillside": 0.2, "country": 0.1, "suburb": 0.15, "walled": 0.1},
    look_alike=0.3,
    crossing_every_m=(80.0, 250.0),
    wavelength_m=(80.0, 500.0),
    steepest=0.07,
)
"""Roads between overgrown hedges, whose face is seen from one lane and whose depth from the other."""
GARDENS = Scenery({"gardens": 0.6, "centre": 0.15, "suburb": 0.1, "estate": 0.05, "park": 0.05, "country": 0.05})
"""Streets of houses with front gardens: low fences that one sees through, hedges cut like walls, old trees."""
SCENERIES = {"town": TOWN, "outskirts": OUTSKIRTS, "lanes": LANES, "gardens": GARDENS}
"""By the names that the command line knows."""
