"""Things that can move: vehicles, riders and people."""

import numpy as np

from sglpr_jax.sim.raw_ids import (
    BICYCLE,
    BICYCLIST,
    BUS,
    CAR,
    MOTORCYCLE,
    MOTORCYCLIST,
    MOVING,
    OTHER_VEHICLE,
    PERSON,
    TRUCK,
)
from sglpr_jax.sim.things import Part, Thing


def car(rng: np.random.Generator) -> Thing:
    """Car: a body of full length, with a shorter and narrower cabin on top."""
    length, width, height = rng.uniform(3.7, 4.8), rng.uniform(1.65, 1.85), rng.uniform(1.4, 1.65)
    cabin, estate = rng.uniform(0.45, 0.7) * length, rng.uniform(0, 0.12) * length
    return (
        Part("box", CAR, (length, width, 0.4 * height), bottom=0.22),
        Part("box", CAR, (cabin, 0.88 * width, 0.4 * height), x=-estate, bottom=0.6 * height),
    )


def van(rng: np.random.Generator) -> Thing:
    length, height = rng.uniform(4.8, 5.8), rng.uniform(1.8, 2.5)
    return (
        Part("box", OTHER_VEHICLE, (length, 1.95, 0.45 * height), bottom=0.25),
        Part("box", OTHER_VEHICLE, (0.8 * length, 1.85, height - 0.3), x=-0.1 * length, bottom=0.3),
    )


def truck(rng: np.random.Generator) -> Thing:
    """Truck: a cab and, behind a gap, the load."""
    length, height = rng.uniform(6, 9), rng.uniform(2.7, 3.6)
    return (
        Part("box", TRUCK, (1.9, 2.2, 2.3), x=length / 2 - 0.95, bottom=0.45),
        Part("box", TRUCK, (length - 2.3, 2.35, height - 0.9), x=-1.15, bottom=0.9),
    )


def bus(rng: np.random.Generator) -> Thing:
    return (Part("box", BUS, (rng.uniform(10, 12.5), 2.5, 2.8), bottom=0.3),)


def bicycle(rng: np.random.Generator) -> Thing:
    return (Part("box", BICYCLE, (rng.uniform(1.6, 1.8), 0.15, 1.0), porosity=0.5),)


def motorcycle(rng: np.random.Generator) -> Thing:
    return (Part("box", MOTORCYCLE, (rng.uniform(1.9, 2.2), 0.45, 1.1), bottom=0.05),)


def _rider(rng: np.random.Generator, label: int, vehicle: Part) -> Thing:
    top = rng.uniform(1.6, 1.85)
    return vehicle._replace(label=label), Part("cylinder", label, (0.4, 0.45, top - 0.7), bottom=0.7)


def bicyclist(rng: np.random.Generator) -> Thing:
    return _rider(rng, BICYCLIST, *bicycle(rng))


def motorcyclist(rng: np.random.Generator) -> Thing:
    return _rider(rng, MOTORCYCLIST, *motorcycle(rng))


def person(rng: np.random.Generator) -> Thing:
    return (Part("cylinder", PERSON, (rng.uniform(0.3, 0.5), rng.uniform(0.4, 0.6), rng.uniform(1.5, 1.9))),)


def people(rng: np.random.Generator) -> Thing:
    """One to three people side by side, including their arms and bags."""
    parts = []
    for place in range(int(rng.integers(1, 4))):
        deep, wide, height = rng.uniform((0.35, 0.5, 1.5), (0.6, 0.8, 1.9)).tolist()
        x, y = rng.uniform(-0.15, 0.15, 2).tolist()
        parts.append(Part("cylinder", PERSON, (deep, wide, height), x, y + 0.75 * place, roughness=0.12))
    return tuple(parts)


def moving(thing: Thing) -> Thing:
    """`thing` with the labels of the moving classes."""
    return tuple(part._replace(label=MOVING[part.label]) for part in thing)


def parked(rng: np.random.Generator) -> Thing:
    """Parked vehicle, mostly a car."""
    make = (car, van, truck)[rng.choice(3, p=[0.955, 0.03, 0.015])]
    return make(rng)
