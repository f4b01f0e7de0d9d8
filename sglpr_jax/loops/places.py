"""A map of places on disk, in which tomorrow's scan finds itself: an index, and an image and a pose for each place."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float, UInt8

from sglpr_jax.data.mounting import MODEL_HEIGHT_M, Mounting
from sglpr_jax.data.record import Record
from sglpr_jax.data.recording import Recording
from sglpr_jax.files import replacing
from sglpr_jax.loops.candidates import CandidateFinder
from sglpr_jax.loops.choices import CANDIDATES, SPACING_M
from sglpr_jax.loops.loop import Loop, planar_loop
from sglpr_jax.loops.probability import Evidence, LoopModel, default_model
from sglpr_jax.loops.verification import VerificationConfig, align_all
from sglpr_jax.models.params import Params
from sglpr_jax.poses import NEGATIVE_M
from sglpr_jax.retrieval.index import Index

ARRAYS = ("images", "world_from_place", "mountings")
"""What a map's file holds beside the index."""


class Relocated(NamedTuple):
    """Where a scan was taken, by one place of the map."""

    place: str
    """The id of the place."""
    world_from_query: Float[np.ndarray, "4 4"]
    """The pose of the scan's sensor (LiDAR frame, tilted as the sensor is) in the map's frame."""
    loop: Loop
    """The place is its match; its query is the number of places, that is, the next one."""

    @property
    def probability(self) -> float:
        """That the scan was taken there."""
        return self.loop.probability


@dataclasses.dataclass(frozen=True, eq=False)
class PlaceMap:
    """Places of one world frame, from one drive or several.

    Example:
      places = PlaceMap.of(recording, params, poses)
      places.save("town.safetensors")
      best = PlaceMap.load("town.safetensors").relocate(params, record)[0]
    """

    index: Index
    images: UInt8[np.ndarray, "n h h"]
    """The density images, 8 bits."""
    world_from_place: Float[np.ndarray, "n 4 4"]
    """Poses of the LiDAR."""
    mountings: Float[np.ndarray, "n 4"]
    """How the sensor was mounted: its height over the ground, metres, and the direction of up in its frame."""

    def __len__(self) -> int:
        return len(self.index)

    @classmethod
    def of(
        cls,
        recording: Recording,
        params: Params,
        poses: Float[np.ndarray, "n 4 4"],
        *,
        spacing_m: float = SPACING_M,
        on_progress: Callable[[int], None] = lambda done: None,
    ) -> "PlaceMap":
        """The map of a recording whose poses (LiDAR frame, in the world) are known.

        A place's id is `RECORDING/SCAN`. Scans that show next to nothing are left out. Raises ValueError for poses of
        another length, and for a recording without scans that show something.
        """
        if len(poses) != len(recording) or not len(recording):
            raise ValueError(f"expected a pose for each of {len(recording)} scans of a recording, found {len(poses)}")
        finder = CandidateFinder(params)
        rows, images, last = [], [], None
        for i in range(len(recording)):
            here = poses[i, :3, 3]
            if last is None or np.linalg.norm(here - last) >= spacing_m:
                seen = finder.seen(recording.record(i, labels=False))
                if not finder.is_empty(seen.image):
                    finder.index.add(seen.descriptor, ids=f"{recording.name}/{recording.ids[i]}", positions=here)
                    rows.append(i)
                    images.append(seen.image)
                    last = here
            on_progress(i + 1)
        if not rows:
            raise ValueError(f"{recording.name}: expected scans that show something, found {len(recording)} empty ones")
        sensor = recording.mounting or Mounting(MODEL_HEIGHT_M)
        mountings = np.tile([sensor.height_m, *sensor.up], (len(rows), 1))
        return cls(finder.index, np.stack(images), np.asarray(poses, np.float64)[rows], mountings)

    def mounting(self, row: int = -1) -> Mounting:
        """How the sensor of a place was mounted; without `row` that of the place added last."""
        height, *up = self.mountings[row].tolist()
        return Mounting(height, tuple(up))

    def merged(self, other: "PlaceMap") -> "PlaceMap":
        """The places of both, in one world frame; ValueError where other weights or images made them."""
        if other.images.shape[1:] != self.images.shape[1:]:
            raise ValueError(f"expected images of {self.images.shape[1:]} cells, found {other.images.shape[1:]}")
        index = Index.empty(self.index.width, weights_hash=self.index.weights_hash, distance=self.index.distance)
        for one in (self.index, other.index):
            index.add(one.descriptors, ids=one.ids, positions=one.positions, weights_hash=one.weights_hash)
        both = (np.concatenate([getattr(self, name), getattr(other, name)]) for name in ARRAYS)
        return PlaceMap(index, *both)

    def relocate(
        self, params: Params, record: Record, *, model: LoopModel | None = None, candidates: int = CANDIDATES
    ) -> list[Relocated]:
        """Where a scan or image may have been taken: the poses by its nearest places, the most probable first.

        The record's mounting says how its sensor is mounted; `mounting()` is that of the map's. None for a scan that
        shows next to nothing. Raises ValueError where other weights made the map.
        """
        finder = CandidateFinder(params)
        descriptor, image, mounting = finder.seen(record)
        exclude = np.full(len(self), finder.is_empty(image))
        found = self.index.query(descriptor, candidates, exclude=exclude, weights_hash=finder.index.weights_hash)
        rows, distances = (values[found.rows >= 0] for values in found)
        if not len(rows):
            return []
        model = default_model(self.index.weights_hash) if model is None else model
        alignments = jax.device_get(align_all(image, self.images[rows], config=VerificationConfig()))
        pairs = []
        for k, (row, distance) in enumerate(zip(rows, distances, strict=True)):
            alignment = alignments.one(k)
            margin = self._other_place(descriptor, int(row)) - distance
            evidence = Evidence.of(float(distance), margin, alignment.correlation, alignment.second)
            mountings = {"query_mounting": mounting, "match_mounting": self.mounting(int(row))}
            probability = float(model.probability(evidence))
            loop = planar_loop(len(self), int(row), alignment, probability=probability, **mountings)
            pose = self.world_from_place[row] @ loop.match_from_query
            pairs.append(Relocated(self.index.ids[row], pose, loop))
        return sorted(pairs, key=lambda pair: -pair.probability)

    def save(self, path: Path | str) -> None:
        """Write one file, whole or not at all: the index's, with images and poses beside its arrays."""
        path = Path(path)
        content = self.index.to_bytes({name: getattr(self, name) for name in ARRAYS})
        with replacing(path) as temporary:
            temporary.write_bytes(content)

    @classmethod
    def load(cls, path: Path | str, *, weights_hash: str | None = None) -> "PlaceMap":
        """Read what `save` wrote. Errors are those of `Index.load`; ValueError for an index alone too."""
        index, more = Index.load_with(path, weights_hash=weights_hash)
        left_out = [name for name in ARRAYS if name not in more]
        if left_out:
            raise ValueError(f"{path}: expected a map of places, found an index without {', '.join(left_out)}")
        return cls(index, *(more[name] for name in ARRAYS))

    def _other_place(self, descriptor: Float[np.ndarray, " d"], row: int) -> float:
        near = np.linalg.norm(self.world_from_place[:, :3, 3] - self.world_from_place[row, :3, 3], axis=1) <= NEGATIVE_M
        distance = float(self.index.query(descriptor, exclude=near).distances[0])
        return distance if np.isfinite(distance) else np.nan
