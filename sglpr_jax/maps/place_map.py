"""Map of places with known poses: merging, relocalisation of scans in it, and its file."""

import dataclasses
import functools
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy.typing import ArrayLike

from sglpr_jax.data.choices import Scale
from sglpr_jax.data.gravity import GroundFilter
from sglpr_jax.data.mounting import Mounting, upright_from_lidar
from sglpr_jax.data.poses import as_poses
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scaled import scaled_poses, scaled_scan
from sglpr_jax.data.scan import Scan, as_scan
from sglpr_jax.fields import check_value
from sglpr_jax.files import naming, write_bytes
from sglpr_jax.loops.candidates import CandidateSearch
from sglpr_jax.loops.closure import LoopClosure, in_metres, planar_loop, to_lidar
from sglpr_jax.loops.comparison import KeyframeComparison, Query
from sglpr_jax.loops.config import CANDIDATES, MIN_CELLS, CandidateConfig, PlaceCount
from sglpr_jax.loops.keyframes import Keyframe, Keyframes
from sglpr_jax.loops.probability import LoopModel, default_model
from sglpr_jax.models.weights import Params
from sglpr_jax.odometry.bev_odometry import BevOdometry
from sglpr_jax.odometry.drift_model import DriftModel
from sglpr_jax.registration.bev_spectra import within_reach
from sglpr_jax.retrieval.index import Index
from sglpr_jax.same_place import NEGATIVE_M
from sglpr_jax.schema import Column, check_columns
from sglpr_jax.se3 import ROTATION_TOLERANCE, inverse


class Relocalization(NamedTuple):
    """Pose of a scan, estimated from one place of the map."""

    place: str
    """Id of the place."""
    world_from_query: Float[np.ndarray, "4 4"]
    """Pose of the scan's LiDAR (tilted if the sensor is) in the frame of the map, in metres."""
    loop: LoopClosure
    """Loop between scan and place. `match` is the row of the place, `query` is the number of places."""

    @property
    def probability(self) -> float:
        """Probability that the scan shows the place."""
        return self.loop.probability


def exclusive_answers(answers: Sequence[Relocalization], *, apart_m: float) -> list[Relocalization]:
    """Keep the most probable answer of each position, and divide the probabilities so that their sum is at most 1.

    An answer is left out if it is within `apart_m` metres of one with a higher probability. The most probable is first.
    """
    distinct: list[Relocalization] = []
    for answer in sorted(answers, key=lambda answer: -answer.probability):
        position = answer.world_from_query[:3, 3]
        if all(np.linalg.norm(other.world_from_query[:3, 3] - position) > apart_m for other in distinct):
            distinct.append(answer)
    total = max(1.0, sum(answer.probability for answer in distinct))
    return [
        answer._replace(loop=dataclasses.replace(answer.loop, probability=answer.probability / total))
        for answer in distinct
    ]


NO_DRIFT = DriftModel(metres_per_metre=1e-3, degrees_per_metre=1e-4, height_per_metre=1e-3)
"""Assumed drift of the poses of a map, which are known: almost none between places. A query has an unknown pose."""
ARRAYS = {
    "images": Column("uint8", ("n", "h", "h")),
    "world_from_place": Column("float64", ("n", 4, 4)),
    "mountings": Column("float64", ("n", 4)),
    "mounting_deviations": Column("float64", ("n", 2), finite=False, optional=True),
}
"""Arrays of a map's file in addition to those of the index. `mounting_deviations` is missing if no sensor tilts."""


@dataclasses.dataclass(frozen=True, eq=False)
class PlaceMap(Keyframes):
    """Places in one world frame, from one or more drives: the keyframes of sessions with known poses.

    Example:
      places = map_recording(recording, params, poses).places
      places.save("town.safetensors")
      best = PlaceMap.load("town.safetensors").relocate(params, scan)[0]
    """

    index: Index
    images: UInt8[np.ndarray, "n h h"]
    """Density images, 8 bits."""
    world_from_place: Float[np.ndarray, "n 4 4"]
    """Pose of the LiDAR at each place."""
    mountings: Float[np.ndarray, "n 4"]
    """Mounting of the sensor at each place: height above the ground in metres, and the up direction in its frame."""
    mounting_deviations: Float[np.ndarray, "n 2"]
    """Standard deviations of height (metres) and tilt (degrees), NaN for a sensor fixed to a vehicle."""

    def __len__(self) -> int:
        return len(self.index)

    def mounting(self, row: int = -1) -> Mounting:
        """Mounting of the sensor at a place, by default the last one."""
        height, *up = self.mountings[row].tolist()
        deviations = self.mounting_deviations[row].tolist()
        if np.isnan(deviations).any():  # fixed to a vehicle
            return Mounting(height, tuple(up))
        return Mounting(height, tuple(up), *deviations)

    def query_mounting(self, points: Float[np.ndarray, "n 3"]) -> Mounting:
        """Return the assumed mounting of a query's sensor: that of the last place.

        If the sensor of the map tilts, the mounting is estimated from the ground in `points`, starting at the median
        height and up direction of all places.
        """
        if not self.tilts:
            return self.mounting()
        height, *up = np.median(self.mountings, axis=0)
        median_mounting = Mounting(float(height), tuple((np.array(up) / np.linalg.norm(up)).tolist()))
        return GroundFilter(median_mounting).add(points)

    @property
    def scale(self) -> Scale:
        """Factor for all lengths of the described scans (`data.scaled`). Poses and mountings are in metres."""
        return self.index.scale

    @property
    def tilts(self) -> bool:
        """Whether the mounting of some place was estimated from its scan, because the sensor tilts."""
        return bool(np.isfinite(self.mounting_deviations).all(axis=1).any())

    def merged(self, other: "PlaceMap", *, drive: Mapping[str, Float[np.ndarray, "4 4"]] | None = None) -> "PlaceMap":
        """Return the map with the places of `other`, which has the same world frame. Common places are stored once.

        If an id of `other` belongs to a different place here, the recordings of `other` get a suffix ~2, ~3, and so on.
        If `other` is a part of a drive, pass the poses of all its scans as `drive`, by their ids (`place_names`). The
        suffix is then that of the complete map.

        Raises ValueError if the maps were made with other weights or another scale, or have images of another size.
        """
        self.index.check(scale=other.scale, weights=other.index.weights_hash)
        if other.images.shape[1:] != self.images.shape[1:]:
            raise ValueError(f"expected images of {self.images.shape[1:]} cells, found {other.images.shape[1:]}")
        contents, other_contents = self._contents(), other._contents()
        known_contents = set(contents)
        new_rows = [row for row, content in enumerate(other_contents) if content not in known_contents]
        drive_contents: dict[str, Content] = {name: (None, pose.tobytes()) for name, pose in (drive or {}).items()}
        drive_contents |= zip(other.index.ids, other_contents, strict=True)
        existing = dict(zip(self.index.ids, contents, strict=True))
        index = self.subset(range(len(self))).index  # a copy, because an index grows in place
        index.add(
            other.index.descriptors[new_rows],
            ids=_unused_ids([other.index.ids[row] for row in new_rows], drive_contents, existing=existing),
            positions=other.world_from_place[new_rows, :3, 3],
        )
        arrays = {name: np.concatenate([getattr(self, name), getattr(other, name)[new_rows]]) for name in ARRAYS}
        return PlaceMap(index, **arrays)

    def relocate(
        self,
        params: Params,
        scan: Scan | ArrayLike,
        *,
        model: LoopModel | None = None,
        candidates: int = CANDIDATES,
    ) -> list[Relocalization]:
        """Locate a scan or image in the map.

        Arguments:
          params: Weights that made the map.
          scan: A scan, points (n, 3) in metres or an image (h, w). Points are taken from a sensor mounted like that of
            the map (`query_mounting`). For another mounting pass a `Scan`.
          model: Model of the probabilities, by default the shipped one.
          candidates: Number of places that the query is compared with, chosen by a coarse comparison with the nearest
            ones. If it fits none of them well, as many more are compared.

        Returns:
          The most probable pose, then poses that are more than 20 m, divided by the scale, from every more probable
          one. Their probabilities add up to at most 1. Empty if the scan is almost empty.

        Raises:
          ValueError: If other weights made the map, if an array has another shape, or if `candidates` is not from 1 to
            1000.
          TypeError: If an argument is not parameters, a scan or an array.
        """
        check_value(candidates, PlaceCount, "candidates")
        finder, query = CandidateSearch(params), as_scan(scan)
        if len(self) and not isinstance(scan, Scan) and query.points is not None:
            query = dataclasses.replace(query, mounting=self.query_mounting(query.points))
        return self.relocate_keyframe(
            finder.keyframe(scaled_scan(query, self.scale)),
            weights_hash=finder.index.weights_hash,
            model=model,
            candidates=candidates,
        )

    def relocate_keyframe(
        self,
        keyframe: Keyframe,
        *,
        weights_hash: str | None,
        model: LoopModel | None = None,
        candidates: int = CANDIDATES,
    ) -> list[Relocalization]:
        """Locate a described scan in the map. Arguments, result and errors are those of `relocate`. `keyframe` must be
        described at the map's scale by weights with the hash `weights_hash`. None skips the check."""
        self.index.check(weights=weights_hash)
        image = keyframe.image
        if len(self) and within_reach(image).shape != within_reach(self.images[0]).shape:
            raise ValueError(f"expected an image of {self.images.shape[1:]} cells as in the map, found {image.shape}")
        if not len(self) or np.count_nonzero(image) < MIN_CELLS:
            return []
        model = default_model() if model is None else model
        config = CandidateConfig(candidates=candidates, further=max(candidates, CandidateConfig().further))
        query = Query(len(self), keyframe.descriptor, image)
        comparison = KeyframeComparison(self._motion, NO_DRIFT, config)
        fits = comparison.compare(query, self)
        best_first = np.argsort(-np.nan_to_num(fits.peaks.correlation), kind="stable")
        _, first = np.unique(fits.frames[best_first], return_index=True)  # a place may be compared twice
        answers = []
        for row in best_first[np.sort(first)][:candidates].tolist():
            candidate = comparison.candidate_of_fit(query, fits, row, self)
            place, probability = candidate.match, float(model.probability(candidate.evidence))
            mountings = keyframe.mounting, self.mounting(place).scaled(self.scale)
            loop = planar_loop(
                candidate.query, candidate.match, candidate.alignment, probability=probability, sensors=mountings
            )
            loop = in_metres(to_lidar(loop, query=mountings[0], match=mountings[1]), self.scale)
            world_from_query = self.world_from_place[place] @ loop.match_from_query
            answers.append(Relocalization(self.index.ids[place], world_from_query, loop))
        return exclusive_answers(answers, apart_m=NEGATIVE_M / self.scale)

    @property
    def frames(self) -> Int[np.ndarray, " n"]:
        """See `Keyframes`."""
        return np.arange(len(self))

    def image(self, row: int) -> UInt8[np.ndarray, "h h"]:
        """See `Keyframes`."""
        return self.images[row]

    @functools.cached_property
    def _motion(self) -> BevOdometry:
        """Poses of the places at the map's scale, then a frame of unknown pose for the query. The world is level."""
        motion = BevOdometry.of(self.upright_poses(self.scale))
        motion.add(0.0, continues=False)
        return motion

    def upright_poses(self, scale: Scale = 1) -> Float[np.ndarray, "n 4 4"]:
        """Return the pose of the sensor's gravity-aligned frame at each place, with lengths multiplied by `scale`."""
        uprights = [upright_from_lidar(self.mounting(row).scaled(scale)) for row in range(len(self))]
        return scaled_poses(self.world_from_place, float(scale)) @ inverse(np.array(uprights).reshape(-1, 4, 4))

    def keyframe(self, row: int) -> Keyframe:
        """Description of the scaled scan at a place."""
        return Keyframe(self.index.descriptors[row], self.images[row], self.mounting(row).scaled(self.scale))

    def subset(self, rows: Sequence[int]) -> "PlaceMap":
        """Return a map of the places in these rows, in this order."""
        rows, index = list(rows), self.index.without_places()
        ids, positions = [self.index.ids[row] for row in rows], self.world_from_place[rows, :3, 3]
        index.add(self.index.descriptors[rows], ids=ids, positions=positions)
        return PlaceMap(index, **{name: getattr(self, name)[rows] for name in ARRAYS})

    def moved(self, world_from_old: Float[np.ndarray, "4 4"]) -> "PlaceMap":
        """Return the map in another world frame, in which the frame of this map has the pose `world_from_old`."""
        moved = dataclasses.replace(self, world_from_place=world_from_old @ self.world_from_place)
        return moved.subset(range(len(self)))  # with the moved positions in its index

    def save(self, path: Path | str) -> None:
        """Write the map atomically to one file: an index file with additional arrays (`ARRAYS`)."""
        arrays = {name: getattr(self, name) for name in ARRAYS if self.tilts or not ARRAYS[name].optional}
        write_bytes(Path(path), self.index.to_bytes(arrays))

    @classmethod
    def load(cls, path: Path | str, *, weights_hash: str | None = None) -> "PlaceMap":
        """Read a file of `save`. Raises the errors of `Index.load`, and ValueError if the file has no valid map."""
        index, arrays = Index.load_with_arrays(path, weights_hash=weights_hash)
        missing = [name for name, column in ARRAYS.items() if name not in arrays and not column.optional]
        if missing:
            raise ValueError(f"{path}: expected a map of places, found an index without {', '.join(missing)}")
        with naming(path):
            _check_arrays(index, arrays)
        return cls(index, **{name: arrays.get(name, np.full((len(index), 2), np.nan)) for name in ARRAYS})

    def _contents(self) -> list[tuple[bytes, bytes]]:
        """Descriptor and pose of each place, as bytes."""
        places = zip(self.index.descriptors, self.world_from_place, strict=True)
        return [(descriptor.tobytes(), pose.tobytes()) for descriptor, pose in places]


def _check_arrays(index: Index, arrays: Mapping[str, np.ndarray]) -> None:
    """Raise ValueError if the index or the arrays (`ARRAYS`) of a file are not those of a map."""
    if index.distance != "l2":
        raise ValueError(f"expected descriptors compared by l2, found {index.distance}")
    check_columns(arrays, ARRAYS, n=len(index))
    if arrays["images"].shape[1] % 2:
        raise ValueError(f"expected images of an even number of cells, found {arrays['images'].shape[1:]}")
    as_poses(arrays["world_from_place"], of="world_from_place")
    for height, *up in np.unique(arrays["mountings"], axis=0).tolist():
        Mounting(height, tuple(up))
        if abs(np.linalg.norm(up) - 1) > ROTATION_TOLERANCE:
            raise ValueError(f"expected up directions of length 1 in mountings, found {up}")


Content = tuple[bytes | None, bytes]
"""Content of a place, by which equal places are found: descriptor (None if not known yet) and pose, as bytes."""


def place_names(recording: Recording) -> list[str]:
    """Return the id that each scan has as a place of a map: RECORDING/SCAN."""
    return [f"{recording.name}/{scan}" for scan in recording.ids]


def _unused_ids(ids: Sequence[str], drive: Mapping[str, Content], *, existing: Mapping[str, Content]) -> list[str]:
    """Return the ids of new places (RECORDING/SCAN), with a suffix of the recording if another place has one of them.
    The suffix is the first of "", ~2, ~3, ... that no scan of the `drive` shares with a different place of the map
    (`existing`). All scans count, because the suffix must not depend on how much of the drive is mapped."""
    recordings = {name.rpartition("/")[0] for name in ids}
    drive = {name: content for name, content in drive.items() if name.rpartition("/")[0] in recordings}

    def is_free(suffix: str) -> bool:
        """Return False if a scan of the drive, with the suffix, has the id of a place with other content."""
        for name, (descriptor, pose) in drive.items():
            place = existing.get(_with_suffix(name, suffix))
            if place is not None and (place[1] != pose or descriptor not in (None, place[0])):
                return False
        return True

    suffixes = itertools.chain([""], (f"~{number}" for number in itertools.count(2)))
    suffix = next(filter(is_free, suffixes))
    return [_with_suffix(name, suffix) for name in ids]


def _with_suffix(name: str, suffix: str) -> str:
    """Return an id RECORDING/SCAN with a suffix after the recording."""
    recording, slash, scan = name.rpartition("/")
    return f"{recording}{suffix}{slash}{scan}"
