"""Transform between the world frames of a new and an existing map, and a check that both have the same frame."""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from sglpr_jax.loops.closure import to_upright
from sglpr_jax.loops.consistency import accept_between
from sglpr_jax.loops.frame_alignment import align_frames
from sglpr_jax.maps.place_map import PlaceMap
from sglpr_jax.odometry.bev_odometry import BevOdometry
from sglpr_jax.odometry.drift_model import DriftModel
from sglpr_jax.se3 import travelled, yaw_of

MAX_LOCATED = 300
"""Maximum number of places of the new map that are located in the existing map. They are evenly spaced."""
MIN_PROBABILITY = 0.5
"""Minimum probability of a located place. The located places must also be consistent with each other."""
MAX_APART_M = 5.0
"""Maximum median distance between the positions of common places in two maps of the same world frame, in metres."""


class MapAlignment(NamedTuple):
    """Transform from the world frame of a new map to that of an existing map."""

    old_from_new: Float[np.ndarray, "4 4"]
    """Pose of the new world frame in the existing one."""
    covariance: Float[np.ndarray, "6 6"]
    """Covariance of a small motion of the new frame in itself: x, y, z in metres, then rotations in radians."""
    places: int
    """Number of common places from which the transform was estimated."""
    apart_m: float
    """Median distance in metres between the positions that both maps state for these places, without the transform."""

    def __str__(self) -> str:
        (x, y, z), yaw = self.old_from_new[:3, 3], np.degrees(yaw_of(self.old_from_new))
        along, across, *_, turn = np.sqrt(np.diag(self.covariance))
        return (
            f"transform x {x:.2f} m, y {y:.2f} m, z {z:.2f} m, yaw {yaw:.2f} degrees from {self.places} common places "
            f"(standard deviations {along:.2f} m, {across:.2f} m, {np.degrees(turn):.2f} degrees)"
        )


def align_maps(before: PlaceMap, new: PlaceMap) -> MapAlignment | None:
    """Locate places of a new map in an existing one, and estimate the transform between their world frames.

    `new` is the map of one drive, in order. Returns None if no places are located consistently. Raises
    ValueError if weights or image sizes of the maps differ (`PlaceMap.relocate_keyframe`).
    """
    loops = []
    evenly_spaced_rows = np.unique(np.linspace(0, len(new) - 1, min(len(new), MAX_LOCATED)).astype(int))
    for row in evenly_spaced_rows.tolist():
        answers = before.relocate_keyframe(new.keyframe(row), weights_hash=new.index.weights_hash)
        if answers and answers[0].probability >= MIN_PROBABILITY:
            loops.append(dataclasses.replace(answers[0].loop, query=row))
    if not loops:
        return None
    # To check the loops for consistency, both maps are one motion: the new places follow the existing ones.
    upright_loops = []
    for loop in loops:
        upright = to_upright(loop, query=new.mounting(loop.query), match=before.mounting(loop.match))
        upright_loops.append(dataclasses.replace(upright, query=len(before) + loop.query))
    motion = BevOdometry.joined([BevOdometry.of(places.upright_poses()) for places in (before, new)])
    groups, _ = accept_between(upright_loops, motion, drift=DriftModel(), known=len(before))
    if not groups:
        return None
    accepted_rows = {loop.query - len(before) for loop in groups[0]}
    accepted_loops = [loop for loop in loops if loop.query in accepted_rows]
    old_from_new, covariance = align_frames(
        accepted_loops,
        before.world_from_place,
        new.world_from_place,
        match_travelled_m=np.zeros(len(before)),  # the poses of the existing map are known
        query_travelled_m=travelled(new.world_from_place),
        drift=DriftModel(),
    )
    located_poses = np.array([before.world_from_place[loop.match] @ loop.match_from_query for loop in accepted_loops])
    new_poses = new.world_from_place[[loop.query for loop in accepted_loops]]
    apart_m = np.linalg.norm(located_poses[:, :3, 3] - new_poses[:, :3, 3], axis=1)
    return MapAlignment(old_from_new, covariance, len(accepted_loops), float(np.median(apart_m)))


def check_one_frame(before: PlaceMap, new: PlaceMap) -> None:
    """Raise ValueError if common places of two maps have other positions, so that their world frames differ."""
    alignment = align_maps(before, new)
    if alignment is not None and alignment.apart_m > MAX_APART_M:
        raise ValueError(
            f"expected poses in the world frame of the existing map, found {alignment.places} places that are "
            f"{alignment.apart_m:.1f} m away from where the existing map has them (median); with --frame align the "
            "poses are moved to the existing map"
        )


def without_known_places(before: PlaceMap, new: PlaceMap) -> PlaceMap:
    """The new map without the places whose descriptors the existing map has, so that no scan is added twice."""
    known = {descriptor.tobytes() for descriptor in before.index.descriptors}
    return new.subset([row for row in range(len(new)) if new.index.descriptors[row].tobytes() not in known])
