"""Poses of a scan in a map of places, the answers of `PlaceMap.relocate`."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.choices import Scale
from sglpr_jax.data.scaled import scaled_poses
from sglpr_jax.loops.loop import Loop
from sglpr_jax.loops.scale import divided_loop
from sglpr_jax.same_place import NEGATIVE_M


class Relocated(NamedTuple):
    """Pose of a scan, estimated from one place of the map."""

    place: str
    """Id of the place."""
    world_from_query: Float[np.ndarray, "4 4"]
    """Pose of the scan's LiDAR (tilted if the sensor is) in the frame of the map, in metres."""
    loop: Loop
    """Loop between scan and place. `match` is the row of the place, `query` is the number of places."""

    @property
    def probability(self) -> float:
        """Probability that the scan shows the place."""
        return self.loop.probability

    def divided(self, scale: Scale) -> "Relocated":
        """The same pose in metres, of scans that were multiplied by `scale`."""
        pose = scaled_poses(self.world_from_query, 1 / scale)
        return self._replace(world_from_query=pose, loop=divided_loop(self.loop, scale))


def with_shared_probability(answers: Sequence[Relocated]) -> list[Relocated]:
    """Sort answers by probability, scaled so that those of answers more than `NEGATIVE_M` apart add up to at most 1."""
    groups: list[list[Relocated]] = []
    for one in _most_probable_first(answers):
        position = one.world_from_query[:3, 3]
        near = (group for group in groups if np.linalg.norm(group[0].world_from_query[:3, 3] - position) <= NEGATIVE_M)
        group = next(near, None)
        if group is None:
            groups.append([one])
        else:
            group.append(one)
    total = max(1.0, sum(group[0].probability for group in groups))
    return _most_probable_first(
        [one._replace(loop=dataclasses.replace(one.loop, probability=one.probability / total)) for one in answers]
    )


def _most_probable_first(answers: Sequence[Relocated]) -> list[Relocated]:
    return sorted(answers, key=lambda one: -one.probability)
