"""Sceneries of towns and styles of their neighbourhoods: streets, strips along them, plots and plants."""

import dataclasses
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from sglpr_jax.sim.labels import OTHER_GROUND, PARKING, ROAD, SIDEWALK, TERRAIN
from sglpr_jax.sim.objects import House, Range

BAY_M = 2.3  # depth of a row of parked cars, in metres
CARRIAGEWAY_M = 7.0  # width of the second carriageway of a street with a median, in metres


class Style(NamedTuple):
    """Style of a neighbourhood. Pairs are ranges in metres. Fractions are probabilities."""

    road: Range  # half width of the carriageway; only its mean is used, give or take 0.2 m
    walk: Range  # width of the sidewalk; 0 without a sidewalk
    bays: float  # fraction of the sides with parked cars along the road
    verge: float  # fraction of the sides with a strip between road and sidewalk
    median: float  # fraction of the streets with a planted median and a second carriageway
    posts: float  # fraction of the sides with a row of posts along the road
    signs: float  # traffic signs per metre of side
    lamps: bool
    houses: float  # fraction of the plots with a house
    gap: Range  # between two houses
    set_back: Range  # of the houses
    closed: Range  # length of the border between two entrances
    borders: str  # possible borders of the plots; one is drawn per side
    garden: int  # label of the ground around the houses
    width: Range  # of a house
    depth: Range
    height: Range
    glass: Range  # fraction of a facade that is window
    street_trees: float  # fraction of the sides with a row of trees
    trees: float  # trees and bushes on the plots, per metre of side
    wood: float  # fraction of the sides with a wood along the road
    banks: float  # fraction of the sides with banks beside the road
    slopes: float  # fraction of the sides at the foot of a hill
    old_trees: bool  # whether trees have thick trunks and bare limbs under their crowns
    bystanders: float  # people, bicycles, bins and similar things, per metre of side
    groups: bool  # whether people stand in groups


# fmt: off
_STREETS = {
    # road, walk, bays, verge, median, posts, signs, lamps
    "centre":   ((3.1, 3.8), (1.4, 3.0), 0.75, 0.12, 0.0,  0.0, 0.035, True),
    "suburb":   ((3.0, 3.7), (1.3, 2.4), 0.4,  0.25, 0.0,  0.0, 0.02,  True),
    "estate":   ((3.3, 4.2), (1.6, 2.8), 0.65, 0.5,  0.15, 0.0, 0.02,  True),
    "works":    ((3.6, 4.6), (1.4, 2.5), 0.25, 0.5,  0.25, 0.0, 0.02,  True),
    "park":     ((3.1, 4.0), (1.5, 3.0), 0.25, 0.3,  0.2,  0.0, 0.02,  True),
    "square":   ((3.4, 4.2), (3.0, 5.0), 0.4,  0.0,  0.0,  0.0, 0.02,  True),
    "country":  ((2.9, 3.5), (0.0, 0.0), 0.0,  0.2,  0.0,  0.0, 0.012, False),
    "walled":   ((3.2, 4.6), (1.4, 3.5), 0.1,  0.4,  0.0,  0.0, 0.02,  True),
    "hillside": ((2.9, 4.0), (0.0, 2.0), 0.1,  0.4,  0.0,  0.0, 0.02,  True),
    "hedged":   ((3.0, 4.6), (0.0, 2.5), 0.1,  0.5,  0.0,  0.3, 0.02,  True),
    "gardens":  ((2.9, 3.8), (1.2, 2.4), 0.55, 0.3,  0.0,  0.0, 0.03,  True),
    "highway":  ((6.0, 7.5), (0.0, 0.0), 0.0,  1.0,  1.0,  0.0, 0.02,  False),
}
_PLOTS = {
    # houses, gap, set_back, closed, borders
    "centre":   (0.95, (-3.0, 1.0),  (0.0, 1.0),   (6.0, 30.0),   "none"),
    "suburb":   (0.95, (2.0, 8.0),   (1.5, 6.0),   (6.0, 30.0),   "hedge hedge hedge fence wall none"),
    "estate":   (0.95, (6.0, 20.0),  (4.0, 10.0),  (6.0, 30.0),   "none none hedge fence"),
    "works":    (0.9,  (6.0, 18.0),  (3.0, 12.0),  (6.0, 30.0),   "fence fence wall hedge none"),
    "park":     (0.25, (20.0, 40.0), (8.0, 15.0),  (6.0, 30.0),   "none none hedge fence"),
    "square":   (0.9,  (-3.0, 2.0),  (11.0, 20.0), (6.0, 30.0),   "none"),
    "country":  (0.04, (25.0, 60.0), (6.0, 15.0),  (6.0, 30.0),   "none none hedge"),
    "walled":   (0.6,  (6.0, 30.0),  (6.0, 16.0),  (60.0, 400.0), "screen screen hedge wall"),
    "hillside": (0.4,  (8.0, 40.0),  (3.0, 10.0),  (20.0, 120.0), "none hedge wall fence"),
    "hedged":   (0.4,  (8.0, 40.0),  (6.0, 16.0),  (40.0, 400.0), "hedgerow hedgerow hedgerow screen"),
    "gardens":  (0.95, (1.0, 8.0),   (1.5, 6.0),   (4.0, 16.0),   "trimmed lattice lattice hedge hedge wall none"),
    "highway":  (0.0,  (3.0, 11.0),  (3.0, 8.0),   (6.0, 30.0),   "rail"),
}
_SIZES = {
    # garden, width, depth, height, glass; styles that are not listed are those of the suburb
    "centre":   (SIDEWALK,     (7.0, 18.0),  (8.0, 13.0),  (7.0, 16.0), (0.15, 0.4)),
    "suburb":   (TERRAIN,      (8.0, 14.0),  (7.0, 11.0),  (4.0, 8.0),  (0.1, 0.35)),
    "estate":   (TERRAIN,      (18.0, 38.0), (10.0, 13.0), (8.0, 13.0), (0.1, 0.35)),
    "works":    (PARKING,      (16.0, 40.0), (12.0, 20.0), (5.0, 9.0),  (0.0, 0.2)),
    "park":     (TERRAIN,      (6.0, 9.0),   (4.0, 6.0),   (3.0, 4.0),  (0.1, 0.35)),
    "square":   (OTHER_GROUND, (10.0, 22.0), (8.0, 14.0),  (9.0, 16.0), (0.15, 0.4)),
    "country":  (TERRAIN,      (10.0, 20.0), (7.0, 11.0),  (4.0, 8.0),  (0.1, 0.35)),
    "gardens":  (TERRAIN,      (8.0, 16.0),  (7.0, 11.0),  (5.0, 9.0),  (0.1, 0.35)),
}
_PLANTS = {
    # street_trees, trees, wood, banks, slopes, old_trees, bystanders, groups
    "centre":   (0.15, 0.16, 0.0,  0.0,  0.0, False, 0.05,  False),
    "suburb":   (0.2,  0.9,  0.15, 0.1,  0.0, False, 0.025, False),
    "estate":   (0.4,  0.6,  0.0,  0.0,  0.0, False, 0.03,  False),
    "works":    (0.25, 0.3,  0.0,  0.15, 0.0, False, 0.015, False),
    "park":     (0.4,  1.1,  0.35, 0.35, 0.0, False, 0.03,  False),
    "square":   (0.6,  0.08, 0.0,  0.0,  0.0, False, 0.06,  False),
    "country":  (0.15, 0.5,  0.6,  0.3,  0.0, False, 0.0,   False),
    "walled":   (0.0,  0.7,  0.0,  0.0,  0.0, False, 0.01,  False),
    "hillside": (0.0,  0.5,  0.15, 0.0,  0.6, False, 0.01,  False),
    "hedged":   (0.0,  0.6,  0.0,  0.1,  0.0, False, 0.01,  False),
    "gardens":  (0.4,  1.5,  0.0,  0.0,  0.0, True,  0.02,  True),
    "highway":  (0.0,  0.2,  0.25, 0.6,  0.0, False, 0.0,   False),
}
# fmt: on
STYLES = {
    name: Style(*_STREETS[name], *_PLOTS[name], *_SIZES.get(name, _SIZES["suburb"]), *_PLANTS[name])
    for name in _STREETS
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
    border: str  # border of the plots: "none" or a name in `frontage`
    wood: bool  # whether a wood, banks or the slope of a hill stand there instead of plots, in this order
    bank: bool
    slope: bool
    tree_spacing: float  # distance between street trees, metres; 0 without street trees
    post_spacing: float  # distance between posts, metres; 0 without posts
    row: House | None  # house that repeats along a uniform stretch

    @property
    def verge(self) -> float:
        """Total width of the strips, in metres."""
        return sum((strip.width for strip in self.strips), start=0.0)


def draw_side(rng: np.random.Generator, style: Style, *, has_median: bool, look_alike: bool) -> Side:
    """Draws one side of a stretch in the given style. With `look_alike`, all of its houses are equal."""
    median_width = rng.uniform(2.5, 9.0) if has_median else 0.0
    has_bays = not has_median and rng.random() < style.bays
    strips = []
    if has_median:
        strips = [Strip(median_width, _draw_planted_label(rng)), Strip(CARRIAGEWAY_M, ROAD)]
    if has_bays:
        strips.append(Strip(BAY_M, int(rng.choice((PARKING, ROAD)))))
    if rng.random() < style.verge:
        strips.append(Strip(rng.uniform(0.8, 2.2), _draw_planted_label(rng)))
    if style.walk[1]:  # the style has sidewalks
        strips.append(Strip(rng.uniform(*style.walk), SIDEWALK))
    return Side(
        style=style,
        strips=tuple(strips),
        median=median_width,
        bays=has_bays,
        occupied=rng.uniform(0.25, 0.95),
        set_back=rng.uniform(*style.set_back),
        border=str(rng.choice(style.borders.split())),
        wood=rng.random() < style.wood,
        bank=rng.random() < style.banks,
        slope=style.slopes > 0 and rng.random() < style.slopes,
        tree_spacing=rng.uniform(7, 16) if has_median or rng.random() < style.street_trees else 0.0,
        row=draw_house(rng, style) if look_alike else None,
        post_spacing=rng.uniform(6, 14) if style.posts and rng.random() < style.posts else 0.0,
    )


def _draw_planted_label(rng: np.random.Generator) -> int:
    """Label of a planted strip of ground."""
    return TERRAIN if rng.random() < 0.7 else OTHER_GROUND


def draw_house(rng: np.random.Generator, style: Style) -> House:
    """Draws the size of a house of this style and the fraction of its facade that is window."""
    return House(*(rng.uniform(*limits) for limits in (style.width, style.depth, style.height, style.glass)))


@dataclasses.dataclass(frozen=True)
class Scenery:
    """Parameters of a random town. Pairs are ranges."""

    styles: Mapping[str, float]
    """Relative frequencies of `STYLES` in new neighbourhoods. Where the vehicle drives fast, there is a highway."""
    look_alike: float = 0.12  # fraction of the stretches that are long and uniform
    crossing_every_m: Range = (60.0, 150.0)  # distance from one side street to the next, in metres
    wavelength_m: Range = (150.0, 600.0)  # wavelength of the hills, in metres
    steepest: float = 0.05
    """Maximum slope of the hills. A value of 0.05 is 5 %."""


TOWN = Scenery(
    {"centre": 0.33, "suburb": 0.33, "estate": 0.09, "works": 0.04, "park": 0.08, "square": 0.02, "country": 0.11}
)
OUTSKIRTS = Scenery(
    {"walled": 0.25, "hillside": 0.25, "country": 0.15, "suburb": 0.15, "works": 0.08, "estate": 0.07, "centre": 0.05},
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
