"""Town around a drive: streets, things along them, and traffic."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from sglpr_jax.sim.ground import Ground, draw_relief
from sglpr_jax.sim.levels import Levels
from sglpr_jax.sim.paving import paint_ground
from sglpr_jax.sim.placing import furnish, join, plant_islands, select, to_scene
from sglpr_jax.sim.plants import bush
from sglpr_jax.sim.scenery import TOWN, Scenery
from sglpr_jax.sim.shapes import Scene, Shapes
from sglpr_jax.sim.streets import Network, Path, draw_streets, resample, roundabouts
from sglpr_jax.sim.traffic import traffic

VIEW_M = 110.0
"""Maximum distance of things from the vehicle, in metres. Standing things that never come closer are omitted."""


class World(NamedTuple):
    """Town: all shapes in the world frame, and the ground."""

    scene: Scene
    ground: Ground
    levels: Levels | None = None
    """Storeys above one another, which the scene holds side by side."""


def build_world(
    seed: int | tuple[int, ...],
    trajectory: Float[np.ndarray, "n 2"],
    times: Float[np.ndarray, " n"],
    *,
    scenery: Scenery = TOWN,
) -> World:
    """Builds a town around a drive.

    The town exists only along the path of the vehicle. Nothing is closer to the trajectory than 1.6 m. Equal arguments
    give equal towns.

    Arguments:
      seed: Seed of the town.
      trajectory: x and y of the LiDAR, in metres. Points may be 0.2 to 3 m apart, and the vehicle may stand still.
      times: Times of these positions, in seconds.
      scenery: Scenery of the town.

    Raises:
      ValueError: The trajectory is shorter than 2 m or not finite, or `times` do not increase.
    """
    rng = np.random.default_rng(seed)
    path = resample(trajectory, times)
    relief = draw_relief(rng, scenery)
    network, islands = Network(draw_streets(rng, path, scenery)), roundabouts(path)
    ground = paint_ground(network, islands, relief, path.xy)
    clock = (float(times[0]), float(times[-1]))
    tables = [
        furnish(rng, network, islands, ground, path.xy, clock),
        plant_islands(rng, islands, ground, bush),
        traffic(rng, network, path, ground),
    ]
    shapes, parts = join(*(shapes for shapes, _ in tables)), [part for _, some in tables for part in some]
    keep = _in_view(shapes, path)
    return World(to_scene(select(shapes, keep), [parts[i] for i in np.flatnonzero(keep)]), ground)


def _in_view(shapes: Shapes, path: Path) -> Bool[np.ndarray, " n"]:
    """Whether each shape moves, or is within VIEW_M of the vehicle while it is present."""
    keep = np.any(shapes.velocity != 0, axis=1)
    for i in range(0, len(path.xy), 10):
        near = np.sum((shapes.centre[:, :2] - path.xy[i]) ** 2, axis=1) < VIEW_M**2
        keep |= near & (shapes.since <= path.times[i] + 2) & (shapes.until > path.times[i] - 2)
    return keep
