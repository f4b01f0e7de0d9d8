"""Trees, bushes, hedges and edges of woods, made of porous, rough ellipsoids and boxes."""

import numpy as np

from sglpr_jax.sim.raw_ids import TRUNK, VEGETATION
from sglpr_jax.sim.things import Part, Range, Thing


def _leaves(
    size: tuple[float, float, float], x: float, y: float, bottom: float, *, roughness: float, porosity: float
) -> Part:
    return Part("ellipsoid", VEGETATION, size, x, y, bottom, roughness=roughness, porosity=porosity)


def tree(rng: np.random.Generator, spread: Range) -> Thing:
    """Tree whose crown has a diameter in the range `spread`, in metres. A large crown has several ellipsoids."""
    crown, below = rng.uniform(*spread), rng.uniform(0.9, 2.6)
    thick = 0.12 + 0.05 * crown * rng.uniform(0.6, 1.4)
    parts = [Part("cylinder", TRUNK, (thick, thick, below + 0.35 * crown))]
    lobes = 1 if crown < 3.5 else int(rng.integers(2, 5))
    for _ in range(lobes):
        size = crown * (1.0 if lobes == 1 else rng.uniform(0.6, 0.85))
        x, y = (rng.uniform(-0.5, 0.5, 2) * (crown - size)).tolist()
        low = below + rng.uniform(0, 0.25) * crown * (lobes > 1)
        high = size * rng.uniform(0.8, 1.3)
        parts.append(_leaves((size, size, high), x, y, low, roughness=0.7, porosity=rng.uniform(0.45, 0.75)))
    return tuple(parts)


def limbed_tree(rng: np.random.Generator, spread: Range) -> Thing:
    """Old street tree: a thick trunk and bare limbs under a crown that begins above most lasers."""
    crown, fork = rng.uniform(*spread), rng.uniform(1.2, 2.2)
    thick = rng.uniform(0.25, 0.7)
    parts = [Part("cylinder", TRUNK, (thick, thick, fork + 1.5), roughness=0.05)]
    for _ in range(int(rng.integers(1, 4))):
        wide, high = rng.uniform((0.6, 0.7), (2.2, 1.8)).tolist()
        x, y = rng.uniform(-0.4, 0.4, 2).tolist()
        parts.append(Part("ellipsoid", TRUNK, (wide, wide, high), x, y, fork - 0.2, roughness=0.4, porosity=0.8))
    low, porosity = fork + rng.uniform(-0.3, 1.6), rng.uniform(0.55, 0.85)
    parts.append(_leaves((crown, crown, crown), 0.0, 0.0, low, roughness=0.9, porosity=porosity))
    return tuple(parts)


def conifer(rng: np.random.Generator) -> Thing:
    """Conifer with a crown that reaches the ground."""
    spread = rng.uniform(1.5, 4)
    leaves = _leaves((spread, spread, 3 * spread), 0.0, 0.0, -0.8 * spread, roughness=0.5, porosity=0.45)
    return Part("cylinder", TRUNK, (0.3, 0.3, 1.5)), leaves


def bush(rng: np.random.Generator, large: float = 1.0) -> Thing:
    """Bush of one or two ellipsoids. `large` scales their size."""
    parts = []
    large *= rng.uniform(0.6, 1.7)
    for i in range(int(rng.integers(1, 3))):
        length, width, height = large * rng.uniform((0.8, 0.8, 0.7), (3.0, 2.0, 2.4))
        x, y = i * rng.uniform(-0.5, 0.5, 2) * (length, width)
        leaves = _leaves(
            (length, width, 1.4 * height), float(x), float(y), -0.4 * height, roughness=0.45, porosity=0.45
        )
        parts.append(leaves._replace(yaw=rng.uniform(0, np.pi)))
    return tuple(parts)


def hedge(length: float, thickness: float, height: float) -> Thing:
    """Trimmed hedge along x."""
    return (Part("box", VEGETATION, (length, thickness, height + 0.3), bottom=-0.3, roughness=0.3, porosity=0.25),)


def trimmed_hedge(rng: np.random.Generator, length: float, thickness: float, height: float) -> Thing:
    """Hedge along x that is straight and dense like a wall."""
    size, roughness, porosity = (length, thickness, height + 0.3), rng.uniform(0.05, 0.2), rng.uniform(0.05, 0.25)
    return (Part("box", VEGETATION, size, bottom=-0.3, roughness=roughness, porosity=porosity),)


def hedgerow(rng: np.random.Generator, length: float, thickness: float, height: float) -> Thing:
    """Piece of an overgrown hedge along x: a dense face, with leaves behind it (y > 0) that become thinner."""
    face, porosity = (length, thickness, height + 0.3), rng.uniform(0.2, 0.5)
    parts = [Part("box", VEGETATION, face, bottom=-0.3, roughness=0.12, porosity=porosity)]
    behind = thickness / 2
    for porosity in (0.55, 0.7, 0.8)[: int(rng.integers(0, 4))]:
        depth, top = rng.uniform(0.5, 1.3), height * rng.uniform(0.9, 1.7)
        size, y = (length, depth, top + 0.3), behind + depth / 2
        parts.append(Part("box", VEGETATION, size, y=y, bottom=-0.3, roughness=0.6, porosity=porosity))
        behind += depth
    return tuple(parts)


def thicket(rng: np.random.Generator) -> Thing:
    """Piece of the edge of a wood: undergrowth with visible trunks."""
    parts = [*bush(rng, rng.uniform(1.2, 2.4))]
    for _ in range(int(rng.integers(1, 4))):
        x, y = rng.uniform(-2.5, 2.5, 2).tolist()
        thick = rng.uniform(0.15, 0.45)
        parts.append(Part("cylinder", TRUNK, (thick, thick, rng.uniform(4, 8)), x, y))
        size = rng.uniform(2.5, 5)
        low = rng.uniform(1.0, 3.5)
        parts.append(_leaves((size, size, 1.5 * size), x, y, low, roughness=0.9, porosity=rng.uniform(0.5, 0.75)))
    return tuple(parts)
