"""Alignment of a new map with an existing one whose world frame may differ."""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from sglpr_jax.loops.common_places import Joined, accepted_between
from sglpr_jax.loops.config import ConsistencyConfig, DriftModel
from sglpr_jax.loops.frame_alignment import FrameAlignment, aligned_frames
from sglpr_jax.loops.loop import Loop
from sglpr_jax.loops.places import PlaceMap
from sglpr_jax.loops.seen import Seen
from sglpr_jax.loops.transforms import inverse, moved_covariance, travelled
from sglpr_jax.loops.upright import upright_from_lidar
from sglpr_jax.models.params import Params

SAMPLE = 300
"""Maximum number of places of the new map that are located in the other map. They are evenly spaced."""
MIN_PROBABILITY = 0.5
"""Minimum probability of a located place. The located places must also be consistent with each other."""
MAX_APART_M = 5.0
"""Maximum median distance between located places and their poses in one world frame, in metres."""


class MapAlignment(NamedTuple):
    """Transform from the world frame of a new map to that of an existing map."""

    alignment: FrameAlignment
    """`match_from_query` is the pose of the new world frame in the existing one."""
    loops: int
    """Number of places from which the transform was estimated."""
    apart_m: float
    """Median distance between these places in the existing map and by the poses of the new map, in metres."""


def aligned_maps(params: Params, before: PlaceMap, new: PlaceMap) -> MapAlignment | None:
    """Locate places of a new map in an existing map, and estimate the transform between their world frames.

    Arguments:
      params: Weights that made both maps.
      before: Existing map.
      new: New map of one drive, with its places in order.

    Returns:
      The transform, or None if the maps have no common place.
    """
    rows = np.unique(np.linspace(0, len(new) - 1, min(len(new), SAMPLE)).astype(int)) if len(new) else []
    upright, loops = [], []
    for row in map(int, rows):
        seen = Seen(new.index.descriptors[row], new.images[row], new.mounting(row))
        answer = next(iter(before.relocate_seen(params, seen)), None)
        if answer is not None and answer.probability >= MIN_PROBABILITY:
            loops.append(dataclasses.replace(answer.loop, query=row))
            upright.append(_joined_loop(loops[-1], before, new))
    joined = Joined(
        np.concatenate([_upright(before), _upright(new)]),
        np.concatenate([travelled(one.world_from_place) for one in (before, new)]),
        np.repeat([0, 1], [len(before), len(new)]),
    )
    sets, _ = accepted_between(upright, joined, drift=DriftModel(), config=ConsistencyConfig())
    if not sets:
        return None
    chosen = {loop.query - len(before) for loop in sets[0]}
    some = [loop for loop in loops if loop.query in chosen]
    poses = before.world_from_place, new.world_from_place
    ways = dict(zip(("match_way", "query_way"), map(travelled, poses), strict=True))
    located = [poses[0][loop.match] @ loop.match_from_query for loop in some]
    apart = [np.linalg.norm(pose[:3, 3] - poses[1][loop.query, :3, 3]) for pose, loop in zip(located, some, strict=True)]
    return MapAlignment(aligned_frames(some, *poses, **ways, drift=DriftModel()), len(some), float(np.median(apart)))


def in_frame_of(params: Params, before: PlaceMap, new: PlaceMap, *, align: bool) -> PlaceMap:
    """Return the new map in the world frame of the existing map.

    Arguments:
      params: Weights that made both maps.
      before: Existing map.
      new: New map of one drive.
      align: Estimate the transform between the frames. Otherwise the poses are expected to be in one frame.

    Raises:
      ValueError: If `align` is true and the maps have no common place, or if it is false and the common places of the
        maps are at different positions.
    """
    found = aligned_maps(params, before, new)
    if align:
        if found is None:
            raise ValueError("expected a common place of the two maps to align them, found none")
        return moved(new, found.alignment.match_from_query)
    if found is not None and found.apart_m > MAX_APART_M:
        raise ValueError(
            f"expected poses in the world frame of the existing map, found {found.loops} places of the new map that the "
            f"existing map has {found.apart_m:.1f} m from their poses (median); --frame align estimates the transform, "
            "--frame same adds them as they are"
        )
    return new


def moved(places: PlaceMap, world_from_old: Float[np.ndarray, "4 4"]) -> PlaceMap:
    """The map in another world frame."""
    poses = world_from_old @ places.world_from_place
    index = type(places.index).empty(
        places.index.width, weights_hash=places.index.weights_hash, distance=places.index.distance
    )
    index.add(places.index.descriptors, ids=places.index.ids, positions=poses[:, :3, 3])
    return dataclasses.replace(places, index=index, world_from_place=poses)


def _upright(places: PlaceMap) -> Float[np.ndarray, "n 4 4"]:
    """Pose of the gravity-aligned frame of the sensor at each place."""
    found = [
        pose @ inverse(upright_from_lidar(places.mounting(row))) for row, pose in enumerate(places.world_from_place)
    ]
    return np.array(found).reshape(-1, 4, 4)


def _joined_loop(loop: Loop, before: PlaceMap, new: PlaceMap) -> Loop:
    """The loop in gravity-aligned frames, with the rows of both maps, one after the other."""
    ours = upright_from_lidar(new.mounting(loop.query))
    pose = upright_from_lidar(before.mounting(loop.match)) @ loop.match_from_query @ inverse(ours)
    values = {"match_from_query": pose, "covariance": moved_covariance(loop.covariance, ours)}
    return dataclasses.replace(loop, query=len(before) + loop.query, **values)
