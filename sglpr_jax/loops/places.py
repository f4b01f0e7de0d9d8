"""Maps of places for relocalisation: an index of descriptors, with an image and a pose for each place."""

import dataclasses
import itertools
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Complex, Float, Int, UInt8
from numpy.typing import ArrayLike

from sglpr_jax.data.mounting import MODEL_HEIGHT_M, Mounting
from sglpr_jax.data.record import Record
from sglpr_jax.data.recording import Recording
from sglpr_jax.fields import check_value
from sglpr_jax.files import naming, replacing
from sglpr_jax.loops.candidates import CandidateFinder, Compared, Seen
from sglpr_jax.loops.choices import CANDIDATES, SPACING_M, PlaceCount
from sglpr_jax.loops.config import CandidateConfig, RivalConfig, VerificationConfig
from sglpr_jax.loops.given import check_is, given_poses, given_record
from sglpr_jax.loops.loop import Loop, planar_loop
from sglpr_jax.loops.pose_search import Peak, occupied, query_spectra, search_spectra, within_reach
from sglpr_jax.loops.probability import Evidence, LoopModel, default_model
from sglpr_jax.loops.rivals import distance_share, rival_share
from sglpr_jax.loops.transforms import inverse, transform
from sglpr_jax.loops.unfinished import Unfinished, settings
from sglpr_jax.loops.upright import check_level, upright_from_lidar
from sglpr_jax.loops.verification import refined
from sglpr_jax.models.params import Params
from sglpr_jax.poses import ROTATION_TOLERANCE
from sglpr_jax.retrieval.embed import OnBadScan
from sglpr_jax.retrieval.index import Index
from sglpr_jax.same_place import NEGATIVE_M
from sglpr_jax.schema import Column, check_columns

ARRAYS = {
    "images": Column("uint8", ("n", "h", "h")),
    "world_from_place": Column("float64", ("n", 4, 4)),
    "mountings": Column("float64", ("n", 4)),
}
"""Arrays of a map's file in addition to the index."""
RIVALS = 10
"""Maximum number of rivals of a query."""
RIVAL_SPACING_M = 8.0
"""Minimum distance between rivals, and from rivals to the match, in metres."""
Content = tuple[bytes | None, bytes]
"""Identity of a place: its descriptor (None if not known yet) and its pose, as bytes."""


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


@dataclasses.dataclass(frozen=True, eq=False)
class PlaceMap:
    """Places in one world frame, from one or more drives.

    Example:
      places = PlaceMap.of(recording, params, poses)
      places.save("town.safetensors")
      best = PlaceMap.load("town.safetensors").relocate(params, record)[0]
    """

    index: Index
    images: UInt8[np.ndarray, "n h h"]
    """Density images, 8 bits."""
    world_from_place: Float[np.ndarray, "n 4 4"]
    """Pose of the LiDAR at each place."""
    mountings: Float[np.ndarray, "n 4"]
    """Mounting of the sensor: height above the ground, in metres, and the up direction in its frame."""

    def __len__(self) -> int:
        return len(self.index)

    @classmethod
    def of(
        cls,
        recording: Recording,
        params: Params,
        poses: ArrayLike,
        *,
        spacing_m: float = SPACING_M,
        on_progress: Callable[[int], None] = lambda done: None,
    ) -> "PlaceMap":
        """Create the map of a recording with known poses.

        `map_recording` does the same and can also skip unreadable scans and resume. Raises the errors of
        `map_recording`.

        Arguments:
          recording: The scans.
          params: Weights of the model that describes them.
          poses: Pose of the LiDAR in the world at each scan.
          spacing_m: Minimum distance of consecutive places, in metres.
          on_progress: Called with the number of scans done.
        """
        return map_recording(recording, params, poses, spacing_m=spacing_m, on_progress=on_progress).places

    def mounting(self, row: int = -1) -> Mounting:
        """Mounting of the sensor at a place, by default the last one."""
        height, *up = self.mountings[row].tolist()
        return Mounting(height, tuple(up))

    def merged(self, other: "PlaceMap", *, drive: Mapping[str, Float[np.ndarray, "4 4"]] | None = None) -> "PlaceMap":
        """Merge two maps in one world frame. Places that are in both are stored once.

        If ids of `other` are taken by other places, its recordings are renamed with the suffix ~2, ~3 and so on.

        Arguments:
          other: Map to add.
          drive: Poses of all scans of the recording of `other` (`poses_by_id`). They are needed if `other` is not
            complete, so that its places get the same ids as in the complete map.

        Raises:
          ValueError: If the maps were made with other weights or have images of another size.
        """
        if other.images.shape[1:] != self.images.shape[1:]:
            raise ValueError(f"expected images of {self.images.shape[1:]} cells, found {other.images.shape[1:]}")
        known = set(self._contents())
        new = [row for row, content in enumerate(other._contents()) if content not in known]
        index = Index.empty(self.index.width, weights_hash=self.index.weights_hash, distance=self.index.distance)
        new_ids = self._names_of(other, new, drive or {})
        for one, rows, ids in ((self, list(range(len(self))), self.index.ids), (other, new, new_ids)):
            places = {"ids": ids, "positions": one.world_from_place[rows, :3, 3]}
            index.add(one.index.descriptors[rows], **places, weights_hash=one.index.weights_hash)
        both = (np.concatenate([getattr(self, name), getattr(other, name)[new]]) for name in ARRAYS)
        return PlaceMap(index, *both)

    def relocate(
        self,
        params: Params,
        record: Record | ArrayLike,
        *,
        model: LoopModel | None = None,
        candidates: int = CANDIDATES,
    ) -> list[Relocated]:
        """Locate a scan or image in the map.

        Arguments:
          params: Weights that made the map.
          record: A record, points (n, 3) in metres or an image (h, w). Points are taken from a sensor mounted like that
            of the last place (`mounting`). For another mounting pass a record.
          model: Model of the probabilities, by default the one shipped for the weights.
          candidates: Number of nearest places that the query is compared with.

        Returns:
          One pose for each of the nearest places, the most probable first. Empty if the scan is almost empty.

        Raises:
          ValueError: If other weights made the map, if an array has another shape, or if `candidates` is not from 1 to
            1000.
          TypeError: If an argument is not parameters, a record or an array.
        """
        check_value(candidates, PlaceCount, "candidates")
        finder = CandidateFinder(params)
        record = given_record(record, mounting=self.mounting() if len(self) else None)
        descriptor, image, mounting = finder.seen(record)
        if len(self) and within_reach(image).shape != within_reach(self.images[0]).shape:
            raise ValueError(f"expected an image of {self.images.shape[1:]} cells as in the map, found {image.shape}")
        exclude = np.full(len(self), finder.is_empty(image))
        found = self.index.query(descriptor, candidates, exclude=exclude, weights_hash=finder.index.weights_hash)
        rows, distances = (values[found.rows >= 0] for values in found)
        if not len(rows):
            return []
        model = default_model(self.index.weights_hash) if model is None else model
        settings = VerificationConfig()
        spectra = query_spectra(image, config=settings)
        peaks = jax.device_get(search_spectra(spectra, self.images[rows], config=settings))
        pairs = []
        for k, (row, distance) in enumerate(zip(rows.tolist(), distances.tolist(), strict=True)):
            alignment = jax.device_get(refined(image, self.images[row], peaks.one(k), config=settings))
            shares = self._rival_shares(descriptor, spectra, row, distance, peaks.one(k))
            cells = min(occupied(image, settings), occupied(self.images[row], settings))
            evidence = Evidence.of(distance, shares[0], alignment.correlation, alignment.second, shares[1], cells)
            mountings = {"query_mounting": mounting, "match_mounting": self.mounting(row)}
            probability = float(model.probability(evidence))
            loop = planar_loop(len(self), row, alignment, probability=probability, **mountings)
            pairs.append(Relocated(self.index.ids[row], self.world_from_place[row] @ loop.match_from_query, loop))
        return sorted(_shared(pairs), key=lambda pair: -pair.probability)

    def save(self, path: Path | str) -> None:
        """Write the map atomically to one file: an index file with additional arrays (`ARRAYS`)."""
        path = Path(path)
        content = self.index.to_bytes({name: getattr(self, name) for name in ARRAYS})
        with replacing(path) as temporary:
            temporary.write_bytes(content)

    @classmethod
    def load(cls, path: Path | str, *, weights_hash: str | None = None) -> "PlaceMap":
        """Read a file of `save`. Raises the errors of `Index.load`, and ValueError if the file has no valid map."""
        index, more = Index.load_with(path, weights_hash=weights_hash)
        left_out = [name for name in ARRAYS if name not in more]
        if left_out:
            raise ValueError(f"{path}: expected a map of places, found an index without {', '.join(left_out)}")
        with naming(path):
            _check_map(index, more)
        return cls(index, *(more[name] for name in ARRAYS))

    def _names_of(self, other: "PlaceMap", new: list[int], drive: Mapping[str, Float[np.ndarray, "4 4"]]) -> list[str]:
        """Ids (`recording/scan`) of the new places, with a suffix after the recording if an id is taken.

        The new places depend on how much of the drive is mapped. The suffix must not, so all scans of the drive are
        checked.
        """
        names = [other.index.ids[row] for row in new]
        scans: dict[str, Content] = {name: (None, pose.tobytes()) for name, pose in drive.items()}
        scans |= zip(other.index.ids, other._contents(), strict=True)
        recordings = {_recording_of(name) for name in names}
        coming = {name: content for name, content in scans.items() if _recording_of(name) in recordings}
        mark = _free_mark(dict(zip(self.index.ids, self._contents(), strict=True)), coming)
        return [_marked(name, mark) for name in names]

    def _contents(self) -> Iterator[tuple[bytes, bytes]]:
        """Descriptor and pose of each place, as bytes."""
        for descriptor, pose in zip(self.index.descriptors, self.world_from_place, strict=True):
            yield descriptor.tobytes(), pose.tobytes()

    def _rival_shares(
        self,
        descriptor: Float[np.ndarray, " d"],
        spectra: Complex[Array, "s t f"],
        match: int,
        distance: float,
        peak: Peak,
    ) -> tuple[float, float]:
        """`distance_share` and `rival_share` of a match, with other places of the map as rivals."""
        rows = self._rivals(descriptor, match)
        if peak.correlation < CandidateConfig().min_rival_correlation or not len(rows):
            return np.nan, np.nan
        found = jax.device_get(search_spectra(spectra, self.images[np.resize(rows, RIVALS)])).some(slice(len(rows)))
        upright = self.world_from_place @ inverse(upright_from_lidar(self.mounting(match)))
        query = upright[match] @ transform(float(peak.x), float(peak.y), float(peak.yaw))
        expected = [(inverse(upright[rows]) @ query, np.full(len(rows), RivalConfig().agree_m))]
        apart = np.linalg.norm(self.index.descriptors[rows] - descriptor, axis=1)
        return distance_share(distance, apart, expected), rival_share(found, float(peak.correlation), expected)

    def _rivals(self, descriptor: Float[np.ndarray, " d"], match: int) -> Int[np.ndarray, " k"]:
        """Places with the nearest descriptors, at least `RIVAL_SPACING_M` from the match and from each other."""
        places, chosen = self.world_from_place[:, :3, 3], [match]
        left = np.linalg.norm(self.index.descriptors - descriptor, axis=1)
        for _ in range(RIVALS):
            left[np.linalg.norm(places - places[chosen[-1]], axis=1) < RIVAL_SPACING_M] = np.inf
            if not np.isfinite(left).any():
                break
            chosen.append(int(left.argmin()))
        return np.array(chosen[1:], np.int64)


def _check_map(index: Index, arrays: Mapping[str, np.ndarray]) -> None:
    """Raises ValueError if the content of a file is not that of a map."""
    if index.distance != "l2":
        raise ValueError(f"expected descriptors compared by l2, found {index.distance}")
    check_columns(arrays, ARRAYS, n=len(index))
    if arrays["images"].shape[1] % 2:
        raise ValueError(f"expected images of an even number of cells, found {arrays['images'].shape[1:]}")
    given_poses(arrays["world_from_place"], of="world_from_place")
    for height, *up in np.unique(arrays["mountings"], axis=0).tolist():
        Mounting(height, tuple(up))
        if abs(np.linalg.norm(up) - 1) > ROTATION_TOLERANCE:
            raise ValueError(f"expected up directions of length 1 in mountings, found {up}")


def _shared(pairs: list[Relocated]) -> list[Relocated]:
    """Scale probabilities so that those of answers more than `NEGATIVE_M` apart add up to at most 1."""
    groups: list[list[Relocated]] = []
    for pair in sorted(pairs, key=lambda pair: -pair.probability):
        position = pair.world_from_query[:3, 3]
        near = (group for group in groups if np.linalg.norm(group[0].world_from_query[:3, 3] - position) <= NEGATIVE_M)
        group = next(near, None)
        if group is None:
            groups.append([pair])
        else:
            group.append(pair)
    total = max(1.0, sum(group[0].probability for group in groups))
    return [pair._replace(loop=dataclasses.replace(pair.loop, probability=pair.probability / total)) for pair in pairs]


def poses_by_id(recording: Recording, poses: Float[np.ndarray, "n 4 4"]) -> dict[str, Float[np.ndarray, "4 4"]]:
    """Pose of each scan by the id of its place, whether or not the scan is in the map."""
    return dict(zip(_place_ids(recording), np.asarray(poses, np.float64), strict=True))


def _place_ids(recording: Recording) -> list[str]:
    return [f"{recording.name}/{scan}" for scan in recording.ids]


def _recording_of(name: str) -> str:
    return name.rpartition("/")[0]


def _marked(name: str, mark: str) -> str:
    recording, slash, scan = name.rpartition("/")
    return f"{recording}{mark}{slash}{scan}"


def _free_mark(taken: Mapping[str, Content], coming: Mapping[str, Content]) -> str:
    """First suffix of "", ~2, ~3, ... with which no coming place has the id of another place."""

    def is_taken(name: str, content: Content) -> bool:
        there = taken.get(name, content)
        return there[1] != content[1] or content[0] not in (None, there[0])

    marks = itertools.chain([""], (f"~{number}" for number in itertools.count(2)))
    return next(
        mark for mark in marks if not any(is_taken(_marked(name, mark), content) for name, content in coming.items())
    )


class Mapped(NamedTuple):
    """Map of a recording, with the scans that were skipped."""

    places: PlaceMap
    scans: int
    """Number of processed scans: all, unless the run was stopped."""
    skipped: tuple[str, ...]
    """Ids of scans that cannot be read."""


def map_recording(
    recording: Recording,
    params: Params,
    poses: ArrayLike,
    *,
    spacing_m: float = SPACING_M,
    on_bad_scan: OnBadScan | None = None,
    kept_in: Path | str | None = None,
    should_stop: Callable[[], bool] = lambda: False,
    on_progress: Callable[[int], None] = lambda done: None,
) -> Mapped:
    """Create the map of a recording with known poses.

    The id of a place is `RECORDING/SCAN`. Scans that are almost empty are skipped.

    Arguments:
      recording: The scans.
      params: Weights of the model that describes them.
      poses: Pose of the LiDAR in the world at each scan.
      spacing_m: Minimum distance of consecutive places, in metres. Scans nearer to the last place are not read.
      on_bad_scan: Called with id and error of a scan that cannot be read. The scan is skipped. Without it the error is
        raised.
      kept_in: Checkpoint directory. With the same recording, poses, weights and spacing, the run resumes from it. The
        directory is not removed.
      should_stop: If it returns True, the run ends and returns the map of the processed scans.
      on_progress: Called with the number of processed scans.

    Raises:
      ValueError: If the poses have another length or shape, or if all scans are empty.
      TypeError: If an argument is not a recording, parameters or an array.
    """
    check_is(recording, Recording, by="open_recording")
    poses = given_poses(poses, of="poses")
    if len(poses) != len(recording) or not len(recording):
        raise ValueError(f"{recording.name}: expected a pose for each of {len(recording)} scans, found {len(poses)}")
    check_level(poses, recording.mounting, name=recording.name)
    finder = CandidateFinder(params)
    kept = None if kept_in is None else _recalled(Path(kept_in), finder, recording, poses, spacing_m, on_bad_scan)
    looked_at: list[int] = []  # rows of the recording that are frames of the finder
    frames: list[int] = []  # frames of the finder that are places
    rows: list[int] = []
    done = 0
    for i in range(len(recording)):
        if not rows or np.linalg.norm(poses[i, :3, 3] - poses[rows[-1], :3, 3]) >= spacing_m:
            if len(looked_at) == len(finder.index):  # not seen by an earlier run
                if should_stop():
                    break
                finder.add_seen(finder.seen_scan(recording, i, on_bad_scan), compared=Compared([], None))
                if kept is not None:
                    kept.keep(finder)
            if not finder.empty[len(looked_at)]:
                frames.append(len(looked_at))
                rows.append(i)
            looked_at.append(i)
        done = i + 1
        on_progress(done)
    if kept is not None:
        kept.keep(finder, all=True)
    if not rows and done == len(recording):
        raise ValueError(
            f"{recording.name}: expected at least one scan that is not empty, found {len(recording)} empty ones"
        )
    skipped = tuple(recording.ids[looked_at[row]] for row in finder.missing)
    return Mapped(_places(finder, recording, poses, frames, rows), done, skipped)


def _recalled(
    folder: Path,
    finder: CandidateFinder,
    recording: Recording,
    poses: Float[np.ndarray, "n 4 4"],
    spacing_m: float,
    on_bad_scan: OnBadScan | None,
) -> Unfinished:
    """Open a checkpoint directory and add its frames to the finder."""
    kept = Unfinished.opened(folder, settings(recording, finder, poses=poses, spacing_m=spacing_m))

    def add(seen: Seen | None, compared: Compared) -> None:
        finder.add_seen(seen, compared=compared)

    kept.recall(finder, recording.mounting, add, missing=on_bad_scan is not None)
    return kept


def _places(
    finder: CandidateFinder,
    recording: Recording,
    poses: Float[np.ndarray, "n 4 4"],
    frames: list[int],
    rows: list[int],
) -> PlaceMap:
    """Map of the `rows` of a recording, which are the `frames` of the finder."""
    index = Index.empty(finder.index.width, weights_hash=finder.index.weights_hash)
    names = _place_ids(recording)
    ids = [names[row] for row in rows]
    index.add(finder.index.descriptors[frames], ids=ids, positions=poses[rows, :3, 3])
    images = [finder.images[frame] for frame in frames]
    sensor = recording.mounting or Mounting(MODEL_HEIGHT_M)
    mountings = np.tile([sensor.height_m, *sensor.up], (len(rows), 1))
    return PlaceMap(index, np.stack(images) if images else np.zeros((0, 0, 0), np.uint8), poses[rows], mountings)
