"""Sceneries of towns and styles of their neighbourhoods: streets, strips along them, plots and plants."""

import dataclasses
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from sglpr_jax.sim.objects import OTHER_GROUND, PARKING, ROAD, SIDEWALK, TERRAIN, House, Range

BAY_M = 2.3
"""Depth of a row of parked cars, in metres."""
CARRIAGEWAY_M = 7.0
"""Width of the second carriageway of a street with a median, in metres."""


@dataclasses.dataclass(frozen=True)
class Carriageway:
    """Road and the strips beside it. Pairs are ranges in metres. Fractions are probabilities."""

    road: Range  # half width of the carriageway
    walk: Range  # width of the sidewalk; 0 without a sidewalk
    bays: float = 0.0  # fraction of the sides with parked cars along the road
    verge: float = 0.0  # fraction of the sides with a strip between road and sidewalk
    median: float = 0.0  # fraction of the streets with a planted median and a second carriageway
    posts: float = 0.0  # fraction of the sides with a row of posts along the road
    signs: float = 0.02  # traffic signs per metre of side
    lamps: bool = True


@dataclasses.dataclass(frozen=True)
class Plots:
    """Plots behind the strips. Pairs are ranges in metres."""

    houses: float = 0.95  # fraction of the plots with a house
    gap: Range = (3.0, 11.0)
    set_back: Range = (3.0, 8.0)
    border: tuple[str, ...] = ("none",)  # possible borders of the plots; one is drawn per side
    closed: Range = (6.0, 30.0)  # length of the border between two entrances
    garden: int = TERRAIN  # label of the ground around the houses


@dataclasses.dataclass(frozen=True)
class Sizes:
    """Sizes of houses. Pairs are ranges in metres, except for `glass`."""

    width: Range = (8.0, 14.0)
    depth: Range = (7.0, 11.0)
    height: Range = (4.0, 8.0)
    glass: Range = (0.1, 0.35)  # fraction of a facade that is window


@dataclasses.dataclass(frozen=True)
class Plants:
    """Trees and the like. Fractions are probabilities."""

    street_trees: float = 0.0  # fraction of the sides with a row of trees
    trees: float = 0.0  # trees and bushes on the plots, per metre of side
    wood: float = 0.0  # fraction of the sides with a wood along the road
    banks: float = 0.0  # fraction of the sides with banks beside the road
    slopes: float = 0.0  # fraction of the sides at the foot of a hill
    old_trees: bool = False  # whether trees have thick trunks and bare limbs under their crowns


@dataclasses.dataclass(frozen=True)
class Style:
    """Style of a neighbourhood."""

    street: Carriageway
    plots: Plots = Plots()
    size: Sizes = Sizes()
    plants: Plants = Plants()
    bystanders: float = 0.0  # people, bicycles, bins and similar things, per metre of side
    groups: bool = False  # whether people stand in groups


STYLES = {
    "centre": Style(
        street=Carriageway((3.1, 3.8), (1.4, 3.0), bays=0.75, verge=0.12, signs=0.035),
        plots=Plots(gap=(-3.0, 1.0), set_back=(0.0, 1.0), garden=SIDEWALK),
        size=Sizes(width=(7.0, 18.0), depth=(8.0, 13.0), height=(7.0, 16.0), glass=(0.15, 0.4)),
        plants=Plants(street_trees=0.15, trees=0.16),
        bystanders=0.05,
    ),
    "suburb": Style(
        street=Carriageway((3.0, 3.7), (1.3, 2.4), bays=0.4, verge=0.25),
        plots=Plots(gap=(2.0, 8.0), set_back=(1.5, 6.0), border=("hedge", "hedge", "hedge", "fence", "wall", "none")),
        plants=Plants(street_trees=0.2, trees=0.9, wood=0.15, banks=0.1),
        bystanders=0.025,
    ),
    "estate": Style(
        street=Carriageway((3.3, 4.2), (1.6, 2.8), bays=0.65, verge=0.5, median=0.15),
        plots=Plots(gap=(6.0, 20.0), set_back=(4.0, 10.0), border=("none", "none", "hedge", "fence")),
        size=Sizes(width=(18.0, 38.0), depth=(10.0, 13.0), height=(8.0, 13.0)),
        plants=Plants(street_trees=0.4, trees=0.6),
        bystanders=0.03,
    ),
    "works": Style(
        street=Carriageway((3.6, 4.6), (1.4, 2.5), bays=0.25, verge=0.5, median=0.25),
        plots=Plots(
            houses=0.9,
            gap=(6.0, 18.0),
            set_back=(3.0, 12.0),
            border=("fence", "fence", "wall", "hedge", "none"),
            garden=PARKING,
        ),
        size=Sizes(width=(16.0, 40.0), depth=(12.0, 20.0), height=(5.0, 9.0), glass=(0.0, 0.2)),
        plants=Plants(street_trees=0.25, trees=0.3, banks=0.15),
        bystanders=0.015,
    ),
    "park": Style(
        street=Carriageway((3.1, 4.0), (1.5, 3.0), bays=0.25, verge=0.3, median=0.2),
        plots=Plots(houses=0.25, gap=(20.0, 40.0), set_back=(8.0, 15.0), border=("none", "none", "hedge", "fence")),
        size=Sizes(width=(6.0, 9.0), depth=(4.0, 6.0), height=(3.0, 4.0)),
        plants=Plants(street_trees=0.4, trees=1.1, wood=0.35, banks=0.35),
        bystanders=0.03,
    ),
    "square": Style(
        street=Carriageway((3.4, 4.2), (3.0, 5.0), bays=0.4),
        plots=Plots(houses=0.9, gap=(-3.0, 2.0), set_back=(11.0, 20.0), garden=OTHER_GROUND),
        size=Sizes(width=(10.0, 22.0), depth=(8.0, 14.0), height=(9.0, 16.0), glass=(0.15, 0.4)),
        plants=Plants(street_trees=0.6, trees=0.08),
        bystanders=0.06,
    ),
    "country": Style(
        street=Carriageway((2.9, 3.5), (0.0, 0.0), verge=0.2, signs=0.012, lamps=False),
        plots=Plots(houses=0.04, gap=(25.0, 60.0), set_back=(6.0, 15.0), border=("none", "none", "hedge")),
        size=Sizes(width=(10.0, 20.0)),
        plants=Plants(street_trees=0.15, trees=0.5, wood=0.6, banks=0.3),
    ),
    "walled": Style(
        street=Carriageway((3.2, 4.6), (1.4, 3.5), bays=0.1, verge=0.4),
        plots=Plots(
            houses=0.6,
            gap=(6.0, 30.0),
            set_back=(6.0, 16.0),
            border=("screen", "screen", "hedge", "wall"),
            closed=(60.0, 400.0),
        ),
        plants=Plants(trees=0.7),
        bystanders=0.01,
    ),
    "hillside": Style(
        street=Carriageway((2.9, 4.0), (0.0, 2.0), bays=0.1, verge=0.4),
        plots=Plots(
            houses=0.4,
            gap=(8.0, 40.0),
            set_back=(3.0, 10.0),
            border=("none", "hedge", "wall", "fence"),
            closed=(20.0, 120.0),
        ),
        plants=Plants(trees=0.5, wood=0.15, slopes=0.6),
        bystanders=0.01,
    ),
    "hedged": Style(
        street=Carriageway((3.0, 4.6), (0.0, 2.5), bays=0.1, verge=0.5, posts=0.3),
        plots=Plots(
            houses=0.4,
            gap=(8.0, 40.0),
            set_back=(6.0, 16.0),
            border=("hedgerow", "hedgerow", "hedgerow", "screen"),
            closed=(40.0, 400.0),
        ),
        plants=Plants(trees=0.6, banks=0.1),
        bystanders=0.01,
    ),
    "gardens": Style(
        street=Carriageway((2.9, 3.8), (1.2, 2.4), bays=0.55, verge=0.3, signs=0.03),
        plots=Plots(
            gap=(1.0, 8.0),
            set_back=(1.5, 6.0),
            border=("trimmed", "lattice", "lattice", "hedge", "hedge", "wall", "none"),
            closed=(4.0, 16.0),
        ),
        size=Sizes(width=(8.0, 16.0), height=(5.0, 9.0)),
        plants=Plants(street_trees=0.4, trees=1.5, old_trees=True),
        bystanders=0.02,
        groups=True,
    ),
    "highway": Style(
        street=Carriageway((6.0, 7.5), (0.0, 0.0), verge=1.0, median=1.0, lamps=False),
        plots=Plots(houses=0.0, border=("rail",)),
        plants=Plants(trees=0.2, wood=0.25, banks=0.6),
    ),
}


class Strip(NamedTuple):
    """Strip of ground along the road."""

    width: float  # metres
    label: int


@dataclasses.dataclass(frozen=True)
class Side:
    """One side of a stretch: strips from the kerb outwards, then the plots."""

    style: Style
    strips: tuple[Strip, ...]
    median: float  # width of the median, metres; 0 without a median
    bays: bool  # whether cars park along the first strip
    occupied: float  # fraction of the bays that are occupied
    set_back: float  # distance of the common building line behind the last strip, metres
    border: str
    wood: bool
    bank: bool
    slope: bool
    tree_spacing: float  # distance between street trees, metres; 0 without street trees
    post_spacing: float  # distance between posts, metres; 0 without posts
    row: House | None  # house that repeats along a uniform stretch

    @property
    def verge(self) -> float:
        """Total width of the strips, in metres."""
        return sum((strip.width for strip in self.strips), start=0.0)


def draw_side(rng: np.random.Generator, style: Style, *, median: bool, look_alike: bool) -> Side:
    """Draws one side of a stretch in the given style."""
    width = rng.uniform(2.5, 9.0) if median else 0.0
    bays = not median and rng.random() < style.street.bays
    strips = []
    if median:
        strips = [Strip(width, _planted(rng)), Strip(CARRIAGEWAY_M, ROAD)]
    if bays:
        strips.append(Strip(BAY_M, int(rng.choice((PARKING, ROAD)))))
    if rng.random() < style.street.verge:
        strips.append(Strip(rng.uniform(0.8, 2.2), _planted(rng)))
    if style.street.walk[1]:
        strips.append(Strip(rng.uniform(*style.street.walk), SIDEWALK))
    return Side(
        style=style,
        strips=tuple(strips),
        median=width,
        bays=bays,
        occupied=rng.uniform(0.25, 0.95),
        set_back=rng.uniform(*style.plots.set_back),
        border=str(rng.choice(style.plots.border)),
        wood=rng.random() < style.plants.wood,
        bank=rng.random() < style.plants.banks,
        slope=style.plants.slopes > 0 and rng.random() < style.plants.slopes,
        tree_spacing=rng.uniform(7, 16) if median or rng.random() < style.plants.street_trees else 0.0,
        row=draw_house(rng, style) if look_alike else None,
        post_spacing=rng.uniform(6, 14) if style.street.posts and rng.random() < style.street.posts else 0.0,
    )


def _planted(rng: np.random.Generator) -> int:
    return TERRAIN if rng.random() < 0.7 else OTHER_GROUND


def draw_house(rng: np.random.Generator, style: Style) -> House:
    """Draws the size of a house of this style."""
    return House(
        *(rng.uniform(*span) for span in (style.size.width, style.size.depth, style.size.height, style.size.glass))
    )


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
