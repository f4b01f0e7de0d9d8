"""Maps of places for relocalisation: an index of descriptors, with an image and a pose for each place."""

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Array, Complex, Float, Int, UInt8
from numpy.typing import ArrayLike

from sglpr_jax.data.choices import Scale
from sglpr_jax.data.gravity import GroundFilter
from sglpr_jax.data.mounting import Mounting
from sglpr_jax.data.record import Record
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scaled import scaled_poses, scaled_record
from sglpr_jax.fields import check_value
from sglpr_jax.loops.candidates import CandidateFinder
from sglpr_jax.loops.choices import CANDIDATES, SPACING_M, PlaceCount
from sglpr_jax.loops.compared_image import occupied, within_reach
from sglpr_jax.loops.config import CandidateConfig, RivalConfig
from sglpr_jax.loops.given import check_is, given_record
from sglpr_jax.loops.loop import planar_loop
from sglpr_jax.loops.mapped_scans import map_scans
from sglpr_jax.loops.mountings import upright_from_lidar
from sglpr_jax.loops.place_file import REQUIRED, read_places, write_places
from sglpr_jax.loops.place_names import Content, free_names
from sglpr_jax.loops.pose_search import Peak, search_spectra
from sglpr_jax.loops.probability import Evidence, LoopModel, default_model
from sglpr_jax.loops.relocated import Relocated, with_shared_probability
from sglpr_jax.loops.rivals import MAP_RIVALS, distance_share, rival_places, rival_share
from sglpr_jax.loops.seen import Seen
from sglpr_jax.loops.shortlist import coarse_correlations
from sglpr_jax.loops.spectra import match_spectra, query_spectra
from sglpr_jax.loops.transforms import inverse, transform
from sglpr_jax.loops.verification import refined
from sglpr_jax.models.params import Params
from sglpr_jax.retrieval.index import Index
from sglpr_jax.retrieval.index_rows import check_scale


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
    mounting_deviations: Float[np.ndarray, "n 2"] | None = None
    """Standard deviations of height (metres) and tilt (degrees), NaN for a sensor fixed to a vehicle. None stands for
    NaN everywhere."""

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
        scale: Scale = 1,
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
          scale: Factor for all lengths before scans are described, 1, 2 or 4.
          on_progress: Called with the number of scans done.
        """
        check_is(recording, Recording, by="open_recording")
        scans = map_scans(recording, params, poses, spacing_m=spacing_m, scale=scale, on_progress=on_progress)
        return cls(*scans.places)

    def mounting(self, row: int = -1) -> Mounting:
        """Mounting of the sensor at a place, by default the last one."""
        height, *up = self.mountings[row].tolist()
        deviations = self._deviations[row]
        return Mounting(height, tuple(up), *(() if np.isnan(deviations).any() else deviations.tolist()))

    def query_mounting(self, points: Float[np.ndarray, "n 3"]) -> Mounting:
        """Mounting of the sensor of a query: that of the last place or, if the sensor of the map tilts, by the ground
        of the query near the median of all places."""
        if not self.tilts:
            return self.mounting()
        height, *up = np.median(self.mountings, axis=0)
        mean = Mounting(float(height), tuple((np.array(up) / np.linalg.norm(up)).tolist()))
        return GroundFilter(mean).add(points)

    @property
    def scale(self) -> Scale:
        """Factor for all lengths of the described scans (`data.scaled`). Poses and mountings are in metres."""
        return self.index.scale

    @property
    def tilts(self) -> bool:
        """Whether the mounting of some place was estimated from its scan, because the sensor tilts."""
        return bool(np.isfinite(self._deviations).all(axis=1).any())

    @property
    def _deviations(self) -> Float[np.ndarray, "n 2"]:
        given = self.mounting_deviations
        return np.full((len(self), 2), np.nan) if given is None else given

    def merged(self, other: "PlaceMap", *, drive: Mapping[str, Float[np.ndarray, "4 4"]] | None = None) -> "PlaceMap":
        """Merge two maps in one world frame. Places that are in both are stored once.

        If ids of `other` are taken by other places, its recordings are renamed with the suffix ~2, ~3 and so on.

        Arguments:
          other: Map to add.
          drive: Poses of all scans of the recording of `other` (`poses_by_id`). They are needed if `other` is not
            complete, so that its places get the same ids as in the complete map.

        Raises:
          ValueError: If the maps were made with other weights or another scale, or have images of another size.
        """
        check_scale(self.scale, other.scale)
        if other.images.shape[1:] != self.images.shape[1:]:
            raise ValueError(f"expected images of {self.images.shape[1:]} cells, found {other.images.shape[1:]}")
        known = set(self._contents())
        new = [row for row, content in enumerate(other._contents()) if content not in known]
        coming: dict[str, Content] = {name: (None, pose.tobytes()) for name, pose in (drive or {}).items()}
        coming |= zip(other.index.ids, other._contents(), strict=True)
        taken = dict(zip(self.index.ids, self._contents(), strict=True))
        new_ids = free_names([other.index.ids[row] for row in new], coming, taken=taken)
        index = self.index.without_places()
        for one, rows, ids in ((self, list(range(len(self))), self.index.ids), (other, new, new_ids)):
            places = {"ids": ids, "positions": one.world_from_place[rows, :3, 3]}
            index.add(one.index.descriptors[rows], **places, weights_hash=one.index.weights_hash)
        both = (np.concatenate([getattr(self, name), getattr(other, name)[new]]) for name in REQUIRED)
        deviations = np.concatenate([self._deviations, other._deviations[new]])
        return PlaceMap(index, *both, mounting_deviations=deviations)

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
            of the map (`query_mounting`). For another mounting pass a record.
          model: Model of the probabilities, by default the one shipped for the weights.
          candidates: Maximum number of poses, and number of nearest places that the query is compared with. If it fits
            none of them well, as many others of the nearest 25 are compared, chosen by a coarse comparison.

        Returns:
          One pose for each compared place, the most probable first. Empty if the scan is almost empty.

        Raises:
          ValueError: If other weights made the map, if an array has another shape, or if `candidates` is not from 1 to
            1000.
          TypeError: If an argument is not parameters, a record or an array.
        """
        check_value(candidates, PlaceCount, "candidates")
        finder = CandidateFinder(params)
        given = given_record(record)
        if len(self) and not isinstance(record, Record) and given.points is not None:
            given = dataclasses.replace(given, mounting=self.query_mounting(given.points))
        seen = finder.seen(scaled_record(given, self.scale))
        return self.relocate_seen(seen, weights_hash=finder.index.weights_hash, model=model, candidates=candidates)

    def relocate_seen(
        self, seen: Seen, *, weights_hash: str | None, model: LoopModel | None = None, candidates: int = CANDIDATES
    ) -> list[Relocated]:
        """Locate a described scan in the map. The arguments and answers are those of `relocate`.

        Arguments:
          seen: Description of the scan, with the scale of the map.
          weights_hash: Hash of the weights that described it.
          model: Model of the probabilities, by default the one shipped for the weights.
          candidates: Maximum number of poses.
        """
        image = seen.image
        if len(self) and within_reach(image).shape != within_reach(self.images[0]).shape:
            raise ValueError(f"expected an image of {self.images.shape[1:]} cells as in the map, found {image.shape}")
        exclude = np.full(len(self), np.count_nonzero(image) < CandidateConfig().min_cells)
        nearest = max(candidates, CandidateConfig().further)
        found = self.index.query(seen.descriptor, nearest, exclude=exclude, weights_hash=weights_hash)
        rows, distances = (values[found.rows >= 0] for values in found)
        if not len(rows):
            return []
        model = default_model(self.index.weights_hash) if model is None else model
        spectra, scaled_map = query_spectra(image), self._scaled()
        chosen, peaks = self._compared(spectra, rows, candidates)
        answers = [
            scaled_map._answer(seen, spectra, int(rows[k]), float(distances[k]), peaks.one(i), model)
            for i, k in enumerate(chosen.tolist())
        ]
        return [one.divided(self.scale) for one in with_shared_probability(answers)[:candidates]]

    def seen(self, row: int) -> Seen:
        """Description of the scaled scan at a place."""
        return Seen(self.index.descriptors[row], self.images[row], self.mounting(row).scaled(self.scale))

    def some(self, rows: Sequence[int]) -> "PlaceMap":
        """Return a map of some of the places.

        Arguments:
          rows: Numbers of the places.
        """
        index = self.index.without_places()
        ids, positions = [self.index.ids[row] for row in rows], self.world_from_place[rows, :3, 3]
        index.add(self.index.descriptors[rows], ids=ids, positions=positions)
        arrays = {name: getattr(self, name)[rows] for name in REQUIRED}
        return PlaceMap(index, **arrays, mounting_deviations=self._deviations[rows])

    def moved(self, world_from_old: Float[np.ndarray, "4 4"]) -> "PlaceMap":
        """Return the map in another world frame.

        Arguments:
          world_from_old: Pose of the old world frame in the new one.
        """
        poses = world_from_old @ self.world_from_place
        index = self.index.without_places()
        index.add(self.index.descriptors, ids=self.index.ids, positions=poses[:, :3, 3])
        return dataclasses.replace(self, index=index, world_from_place=poses)

    def save(self, path: Path | str) -> None:
        """Write the map atomically to one file: an index file with additional arrays (`place_file.ARRAYS`)."""
        deviations = {"mounting_deviations": self._deviations} if self.tilts else {}
        write_places(Path(path), self.index, {name: getattr(self, name) for name in REQUIRED} | deviations)

    @classmethod
    def load(cls, path: Path | str, *, weights_hash: str | None = None) -> "PlaceMap":
        """Read a file of `save`. Raises the errors of `Index.load`, and ValueError if the file has no valid map."""
        index, arrays = read_places(path, weights_hash=weights_hash)
        return cls(index, **arrays)

    def _scaled(self) -> "PlaceMap":
        """The same map with poses and mountings of its scaled scans."""
        if self.scale == 1:
            return self
        deviations = self.mounting_deviations
        return dataclasses.replace(
            self,
            world_from_place=scaled_poses(self.world_from_place, float(self.scale)),
            mountings=self.mountings * np.array([self.scale, 1, 1, 1]),
            mounting_deviations=None if deviations is None else deviations * np.array([self.scale, 1]),
        )

    def _contents(self) -> Iterator[tuple[bytes, bytes]]:
        """Descriptor and pose of each place, as bytes."""
        for descriptor, pose in zip(self.index.descriptors, self.world_from_place, strict=True):
            yield descriptor.tobytes(), pose.tobytes()

    def _compared(
        self, spectra: Complex[Array, "2 s t f"], rows: Int[np.ndarray, " n"], count: int
    ) -> tuple[Int[np.ndarray, " k"], Peak]:
        """Indices of the compared places in `rows`, the nearest first, and their peaks. If none of the first `count`
        fits well, as many others are chosen by a coarse comparison."""
        first, others = np.arange(len(rows))[:count], np.arange(len(rows))[count:]
        matches = match_spectra(self.images[rows])
        peaks = jax.device_get(search_spectra(spectra, matches[:count]))
        if not len(others) or peaks.correlation.max() >= CandidateConfig().good_correlation:
            return first, peaks
        more = others[np.argsort(-np.asarray(coarse_correlations(spectra, matches[count:])), kind="stable")[:count]]
        found = jax.device_get(search_spectra(spectra, matches[more]))
        return np.concatenate([first, more]), Peak(*map(np.concatenate, zip(peaks, found, strict=True)))

    def _answer(
        self, seen: Seen, spectra: Complex[Array, "2 s t f"], row: int, distance: float, peak: Peak, model: LoopModel
    ) -> Relocated:
        """Pose of a query by the place `row`."""
        alignment = jax.device_get(refined(seen.image, self.images[row], peak))
        shares = self._rival_shares(seen.descriptor, spectra, row, distance, peak)
        cells = min(occupied(seen.image), occupied(self.images[row]))
        evidence = Evidence.of(distance, shares[0], alignment.correlation, alignment.second, shares[1], cells)
        mountings = {"query_mounting": seen.mounting, "match_mounting": self.mounting(row)}
        probability = float(model.probability(evidence))
        loop = planar_loop(len(self), row, alignment, probability=probability, **mountings)
        return Relocated(self.index.ids[row], self.world_from_place[row] @ loop.match_from_query, loop)

    def _rival_shares(
        self,
        descriptor: Float[np.ndarray, " d"],
        spectra: Complex[Array, "2 s t f"],
        match: int,
        distance: float,
        peak: Peak,
    ) -> tuple[float, float]:
        """`distance_share` and `rival_share` of a match, with other places of the map as rivals."""
        apart = np.linalg.norm(self.index.descriptors - descriptor, axis=1)
        rows = rival_places(apart, self.world_from_place[:, :3, 3], match)
        if peak.correlation < CandidateConfig().min_correlation or not len(rows):
            return np.nan, np.nan
        rivals = match_spectra(self.images[np.resize(rows, MAP_RIVALS)])
        found = jax.device_get(search_spectra(spectra, rivals)).some(slice(len(rows)))
        of_place = np.array([upright_from_lidar(self.mounting(row)) for row in (match, *rows.tolist())])
        upright = self.world_from_place[[match, *rows.tolist()]] @ inverse(of_place)
        query = upright[0] @ transform(float(peak.x), float(peak.y), float(peak.yaw))
        expected = [(inverse(upright[1:]) @ query, np.full(len(rows), RivalConfig().agree_m))]
        return distance_share(distance, apart[rows], expected), rival_share(found, float(peak.correlation), expected)
