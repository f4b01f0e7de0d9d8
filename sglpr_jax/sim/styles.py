"""Styles of neighbourhoods: widths of streets, strips along them, and buildings on the plots."""

import dataclasses
from typing import NamedTuple

import numpy as np

from sglpr_jax.sim.buildings import House
from sglpr_jax.sim.raw_ids import OTHER_GROUND, PARKING, ROAD, SIDEWALK, TERRAIN
from sglpr_jax.sim.things import Range

BAY_M = 2.3
"""Depth of a row of parked cars, in metres."""
CARRIAGEWAY_M = 7.0
"""Width of the second carriageway of a street with a median, in metres."""


@dataclasses.dataclass(frozen=True)
class Style:
    """Style of a neighbourhood. Pairs are ranges in metres, except for `glass`. Fractions are probabilities."""

    road: Range  # half width of the carriageway
    walk: Range  # width of the sidewalk; 0 without a sidewalk
    garden: int  # label of the ground around the houses
    houses: float = 0.0  # fraction of the plots with a house
    width: Range = (8.0, 14.0)
    depth: Range = (7.0, 11.0)
    height: Range = (4.0, 8.0)
    gap: Range = (3.0, 11.0)
    set_back: Range = (3.0, 8.0)
    glass: Range = (0.1, 0.35)  # fraction of a facade that is window
    border: tuple[str, ...] = ("none",)  # possible borders of the plots; one is drawn per side
    closed: Range = (6.0, 30.0)  # length of the border between two entrances
    bays: float = 0.0  # fraction of the sides with parked cars along the road
    verge: float = 0.0  # fraction of the sides with a strip between road and sidewalk
    median: float = 0.0  # fraction of the streets with a planted median and a second carriageway
    street_trees: float = 0.0  # fraction of the sides with a row of trees
    trees: float = 0.0  # trees and bushes on the plots, per metre of side
    wood: float = 0.0  # fraction of the sides with a wood along the road
    banks: float = 0.0  # fraction of the sides with banks beside the road
    posts: float = 0.0  # fraction of the sides with a row of posts along the road
    slopes: float = 0.0  # fraction of the sides at the foot of a hill
    old_trees: bool = False  # whether trees have thick trunks and bare limbs under their crowns
    groups: bool = False  # whether people stand in groups
    bystanders: float = 0.0  # people, bicycles, bins and similar things, per metre of side
    signs: float = 0.02  # traffic signs per metre of side
    lamps: bool = True


STYLES = {
    "centre": Style(
        road=(3.1, 3.8),
        walk=(1.4, 3.0),
        garden=SIDEWALK,
        houses=0.95,
        width=(7.0, 18.0),
        depth=(8.0, 13.0),
        height=(7.0, 16.0),
        gap=(-3.0, 1.0),
        set_back=(0.0, 1.0),
        glass=(0.15, 0.4),
        bays=0.75,
        verge=0.12,
        street_trees=0.15,
        trees=0.16,
        bystanders=0.05,
        signs=0.035,
    ),
    "suburb": Style(
        road=(3.0, 3.7),
        walk=(1.3, 2.4),
        garden=TERRAIN,
        houses=0.95,
        gap=(2.0, 8.0),
        set_back=(1.5, 6.0),
        border=("hedge", "hedge", "hedge", "fence", "wall", "none"),
        bays=0.4,
        verge=0.25,
        street_trees=0.2,
        wood=0.15,
        trees=0.9,
        banks=0.1,
        bystanders=0.025,
    ),
    "estate": Style(
        road=(3.3, 4.2),
        walk=(1.6, 2.8),
        garden=TERRAIN,
        houses=0.95,
        width=(18.0, 38.0),
        depth=(10.0, 13.0),
        height=(8.0, 13.0),
        gap=(6.0, 20.0),
        set_back=(4.0, 10.0),
        border=("none", "none", "hedge", "fence"),
        bays=0.65,
        verge=0.5,
        median=0.15,
        street_trees=0.4,
        trees=0.6,
        bystanders=0.03,
    ),
    "works": Style(
        road=(3.6, 4.6),
        walk=(1.4, 2.5),
        garden=PARKING,
        houses=0.9,
        width=(16.0, 40.0),
        depth=(12.0, 20.0),
        height=(5.0, 9.0),
        gap=(6.0, 18.0),
        set_back=(3.0, 12.0),
        glass=(0.0, 0.2),
        border=("fence", "fence", "wall", "hedge", "none"),
        bays=0.25,
        verge=0.5,
        median=0.25,
        street_trees=0.25,
        trees=0.3,
        banks=0.15,
        bystanders=0.015,
    ),
    "park": Style(
        road=(3.1, 4.0),
        walk=(1.5, 3.0),
        garden=TERRAIN,
        houses=0.25,
        width=(6.0, 9.0),
        depth=(4.0, 6.0),
        height=(3.0, 4.0),
        gap=(20.0, 40.0),
        set_back=(8.0, 15.0),
        border=("none", "none", "hedge", "fence"),
        bays=0.25,
        verge=0.3,
        median=0.2,
        street_trees=0.4,
        trees=1.1,
        wood=0.35,
        banks=0.35,
        bystanders=0.03,
    ),
    "square": Style(
        road=(3.4, 4.2),
        walk=(3.0, 5.0),
        garden=OTHER_GROUND,
        houses=0.9,
        width=(10.0, 22.0),
        depth=(8.0, 14.0),
        height=(9.0, 16.0),
        gap=(-3.0, 2.0),
        set_back=(11.0, 20.0),
        glass=(0.15, 0.4),
        bays=0.4,
        street_trees=0.6,
        trees=0.08,
        bystanders=0.06,
    ),
    "country": Style(
        road=(2.9, 3.5),
        walk=(0.0, 0.0),
        garden=TERRAIN,
        houses=0.04,
        width=(10.0, 20.0),
        gap=(25.0, 60.0),
        set_back=(6.0, 15.0),
        border=("none", "none", "hedge"),
        verge=0.2,
        street_trees=0.15,
        trees=0.5,
        wood=0.6,
        banks=0.3,
        signs=0.012,
        lamps=False,
    ),
    "walled": Style(
        road=(3.2, 4.6),
        walk=(1.4, 3.5),
        garden=TERRAIN,
        houses=0.6,
        gap=(6.0, 30.0),
        set_back=(6.0, 16.0),
        border=("screen", "screen", "hedge", "wall"),
        closed=(60.0, 400.0),
        bays=0.1,
        verge=0.4,
        trees=0.7,
        bystanders=0.01,
    ),
    "hillside": Style(
        road=(2.9, 4.0),
        walk=(0.0, 2.0),
        garden=TERRAIN,
        houses=0.4,
        gap=(8.0, 40.0),
        set_back=(3.0, 10.0),
        border=("none", "hedge", "wall", "fence"),
        closed=(20.0, 120.0),
        bays=0.1,
        verge=0.4,
        trees=0.5,
        wood=0.15,
        slopes=0.6,
        bystanders=0.01,
    ),
    "hedged": Style(
        road=(3.0, 4.6),
        walk=(0.0, 2.5),
        garden=TERRAIN,
        houses=0.4,
        gap=(8.0, 40.0),
        set_back=(6.0, 16.0),
        border=("hedgerow", "hedgerow", "hedgerow", "screen"),
        closed=(40.0, 400.0),
        bays=0.1,
        verge=0.5,
        trees=0.6,
        banks=0.1,
        posts=0.3,
        bystanders=0.01,
    ),
    "gardens": Style(
        road=(2.9, 3.8),
        walk=(1.2, 2.4),
        garden=TERRAIN,
        houses=0.95,
        width=(8.0, 16.0),
        height=(5.0, 9.0),
        gap=(1.0, 8.0),
        set_back=(1.5, 6.0),
        border=("trimmed", "lattice", "lattice", "hedge", "hedge", "wall", "none"),
        closed=(4.0, 16.0),
        bays=0.55,
        verge=0.3,
        street_trees=0.4,
        trees=1.5,
        bystanders=0.02,
        signs=0.03,
        old_trees=True,
        groups=True,
    ),
    "highway": Style(
        road=(6.0, 7.5),
        walk=(0.0, 0.0),
        garden=TERRAIN,
        border=("rail",),
        verge=1.0,
        median=1.0,
        trees=0.2,
        wood=0.25,
        banks=0.6,
        signs=0.02,
        lamps=False,
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
    bays = not median and rng.random() < style.bays
    strips = []
    if median:
        strips = [Strip(width, _planted(rng)), Strip(CARRIAGEWAY_M, ROAD)]
    if bays:
        strips.append(Strip(BAY_M, int(rng.choice((PARKING, ROAD)))))
    if rng.random() < style.verge:
        strips.append(Strip(rng.uniform(0.8, 2.2), _planted(rng)))
    if style.walk[1]:
        strips.append(Strip(rng.uniform(*style.walk), SIDEWALK))
    return Side(
        style=style,
        strips=tuple(strips),
        median=width,
        bays=bays,
        occupied=rng.uniform(0.25, 0.95),
        set_back=rng.uniform(*style.set_back),
        border=str(rng.choice(style.border)),
        wood=rng.random() < style.wood,
        bank=rng.random() < style.banks,
        slope=style.slopes > 0 and rng.random() < style.slopes,
        tree_spacing=rng.uniform(7, 16) if median or rng.random() < style.street_trees else 0.0,
        row=draw_house(rng, style) if look_alike else None,
        post_spacing=rng.uniform(6, 14) if style.posts and rng.random() < style.posts else 0.0,
    )


def _planted(rng: np.random.Generator) -> int:
    return TERRAIN if rng.random() < 0.7 else OTHER_GROUND


def draw_house(rng: np.random.Generator, style: Style) -> House:
    """Draws the size of a house of this style."""
    return House(*(rng.uniform(*span) for span in (style.width, style.depth, style.height, style.glass)))
