"""From a scan to the earlier scans that may show its place: described, looked up, and laid over each other."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Float32, Num, UInt8

from sglpr_jax.bev import centre_crop, even_cells
from sglpr_jax.data.degenerate import check_cloud
from sglpr_jax.data.density_grid import MAX_COUNT
from sglpr_jax.data.mounting import Mounting
from sglpr_jax.data.record import Record
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.views import check_ready_made, image_view, picture, view
from sglpr_jax.loops.drift import DriftModel, position_deviations
from sglpr_jax.loops.given import check_is
from sglpr_jax.loops.probability import Evidence
from sglpr_jax.loops.verification import Alignment, VerificationConfig, align_all
from sglpr_jax.models.params import Params
from sglpr_jax.models.sglpr import describe
from sglpr_jax.models.weights import weights_hash
from sglpr_jax.retrieval.embed import OnBadScan
from sglpr_jax.retrieval.index import Index
from sglpr_jax.revisits import EXCLUDED_FRAMES, EXCLUDED_S
from sglpr_jax.same_place import NEGATIVE_M


@dataclasses.dataclass(frozen=True)
class CandidateConfig:
    """Which earlier scans are looked at."""

    candidates: int = 3
    """How many of the nearest are laid over each scan."""
    exclude_s: float = EXCLUDED_S
    exclude_frames: int = EXCLUDED_FRAMES
    """Scans younger than this are neighbours and no loop: seconds, or frames where there are no times."""
    other_place_frames: int = 50
    """Without odometry, scans so many frames apart are taken for other places."""
    min_cells: int = 20
    """Images of fewer occupied cells, of a sensor that was covered or failed, show no place."""


class Candidate(NamedTuple):
    """Two scans that may show one place."""

    query: int
    match: int
    """Frames, counted from 0; the match is the earlier one."""
    alignment: Alignment
    """How their images lie."""
    evidence: Evidence


class Seen(NamedTuple):
    """What is kept of a scan or ready-made image."""

    descriptor: Float32[np.ndarray, " d"]
    image: UInt8[np.ndarray, "n n"]
    """Its density image."""
    mounting: Mounting | None
    """Of the sensor that was turned upright for both."""


class CandidateFinder:
    """Takes scans as they come, and remembers descriptor and image of each."""

    def __init__(
        self,
        params: Params,
        *,
        config: CandidateConfig = CandidateConfig(),
        verification: VerificationConfig = VerificationConfig(),
        drift: DriftModel = DriftModel(),
    ):
        check_is(params, Params, by="load")
        if params.config.categories_read:
            raise ValueError("expected a model that describes images alone, found one that reads labels too")
        self.params, self.config, self.verification, self.drift = params, config, verification, drift
        self.index = Index.empty(params.config.head.descriptor_size, weights_hash=weights_hash(params))
        self.images: list[UInt8[np.ndarray, "n n"]] = []
        self.odometry: list[Float[np.ndarray, "4 4"]] = []
        self.mounting: Mounting | None = None
        """Of the sensor, one for all frames."""
        self.empty: list[bool] = []
        """Which frames show next to nothing."""
        self.missing: list[int] = []
        """The frames whose scans could not be read."""

    def add(
        self, record: Record, *, time: float | None = None, odometry: Float[np.ndarray, "4 4"] | None = None
    ) -> list[Candidate]:
        """Describe a scan or image, and return its candidates, those of the nearest descriptor first.

        `odometry` is its pose, LiDAR frame in any fixed frame. Raises ValueError where some frames have a time or a
        pose and others have none, where times run backwards, and for a record of a sensor mounted otherwise.
        """
        return self.add_seen(self.seen(record), time=time, odometry=odometry)

    def add_seen(
        self,
        seen: Seen | None,
        *,
        time: float | None = None,
        odometry: Float[np.ndarray, "4 4"] | None = None,
        candidates: list[Candidate] | None = None,
    ) -> list[Candidate]:
        """Do what `add` does, of a record that was looked at before; None where its scan cannot be read.

        `candidates` are those that an earlier run found for it, which saves the search. Errors are those of `add`.
        """
        self._check(seen, time, odometry)
        pose = None if odometry is None else np.asarray(odometry, np.float64)
        position = None if pose is None else pose[:3, 3]
        if candidates is None:
            candidates = [] if seen is None else self._candidates(seen, time, position)
        if seen is None:
            seen = Seen(np.zeros(self.index.width, np.float32), np.zeros((0, 0), np.uint8), self.mounting)
            self.missing.append(len(self.index))
        self.index.add(seen.descriptor, times=time, positions=position)
        self.images.append(seen.image)
        self.empty.append(self.is_empty(seen.image))
        self.mounting = seen.mounting
        if pose is not None:
            self.odometry.append(pose)
        return candidates

    def seen(self, record: Record) -> Seen:
        """The descriptor of a scan or image, and its density image as 8 bits; nothing is remembered."""
        model = self.params.config
        check_ready_made(record, model.image)
        whole, _ = picture(record, None)
        if record.points is None or model.image == "density":
            bev = image_view(whole, None, model.grid).image
        else:
            bev = view(record, model.grid, image=model.image).image
        return Seen(np.asarray(describe(self.params, bev)), _kept(whole), record.mounting)

    def seen_scan(self, recording: Recording, i: int, on_bad_scan: OnBadScan | None) -> Seen | None:
        """What is seen of a recording's scan; None where it cannot be read, which `on_bad_scan(id, error)` is told.

        So it is of a scan that cannot be one of a place: no finite points, no metres. Without `on_bad_scan` the error
        is raised.
        """
        try:
            record = recording.record(i, labels=False)
            if record.points is not None:
                check_cloud(record.points, name=record.name)
            return self.seen(record)
        except (ValueError, OSError) as error:
            if on_bad_scan is None:
                raise
            on_bad_scan(recording.ids[i], error)
            return None

    def is_empty(self, image: UInt8[np.ndarray, "n n"]) -> bool:
        """Whether an image shows too little to tell a place by."""
        return bool(np.count_nonzero(image) < self.config.min_cells)

    def _candidates(self, seen: Seen, time: float | None, position: Float[np.ndarray, " 3"] | None) -> list[Candidate]:
        excluded = self._excluded(time, position) | self.is_empty(seen.image)
        rows, distances = self.index.query(seen.descriptor, self.config.candidates, exclude=excluded)
        rows, distances = rows[rows >= 0], distances[rows >= 0]
        if not len(rows):
            return []
        padded = np.resize(rows, self.config.candidates)  # always as many, so that it compiles once
        matches = np.stack([self.images[row] for row in padded])
        found = jax.device_get(align_all(seen.image, matches, config=self.verification))
        pairs = []
        for k, (row, distance) in enumerate(zip(rows, distances, strict=True)):
            alignment, other = found.one(k), self._other_place(seen.descriptor, int(row), excluded)
            evidence = Evidence.of(distance, other - distance, alignment.correlation, alignment.second)
            pairs.append(Candidate(len(self.index), int(row), alignment, evidence))
        return pairs

    def _check(self, seen: Seen | None, time: float | None, odometry: Float[np.ndarray, "4 4"] | None) -> None:
        if not len(self.index):
            return
        if seen is not None and seen.mounting != self.mounting and len(self.missing) < len(self.index):
            raise ValueError(f"expected one sensor, mounted {self.mounting}, found {seen.mounting}")
        for name, given, known in (
            ("a time", time is not None, self.index.times is not None),
            ("odometry", odometry is not None, bool(self.odometry)),
        ):
            if given != known:
                raise ValueError(f"expected {name} for every frame or for none, found both (frame {len(self.index)})")
        if time is not None and self.index.times is not None and time < self.index.times[-1]:
            raise ValueError(f"expected times that do not go back, found {time} after {self.index.times[-1]}")

    def _excluded(self, time: float | None, position: Float[np.ndarray, " 3"] | None) -> Bool[np.ndarray, " n"]:
        """Frames that are no candidates of the next one: too recent, almost empty, or too far away by odometry."""
        config, known = self.config, self.index.positions
        excluded = self.index.recent(time, seconds=config.exclude_s, frames=config.exclude_frames)
        excluded = excluded | np.array(self.empty, bool)
        if position is not None and known is not None and len(known):
            drifted = position_deviations(np.concatenate([known, position[None]]), -1, drift=self.drift)[:-1]
            apart = np.linalg.norm(known - position, axis=1)
            place_m = np.sqrt(2) * self.verification.max_shift_m  # largest shift along x and y
            excluded = excluded | (apart > place_m + self.drift.max_deviation * drifted)
        return excluded

    def _other_place(self, descriptor: Float32[np.ndarray, " d"], row: int, excluded: Bool[np.ndarray, " n"]) -> float:
        """The distance of the nearest descriptor of a place that is not that of `row`; NaN where there is none."""
        if self.index.positions is not None:
            near = np.linalg.norm(self.index.positions - self.index.positions[row], axis=1) <= NEGATIVE_M
        else:
            near = np.abs(np.arange(len(self.index)) - row) <= self.config.other_place_frames
        distance = float(self.index.query(descriptor, exclude=excluded | near).distances[0])
        return distance if np.isfinite(distance) else np.nan


def labelled(
    candidates: Sequence[Candidate], positions: Float[np.ndarray, "n 3"], *, loop_m: float = 10.0
) -> tuple[Evidence, Bool[np.ndarray, " m"]]:
    """The evidence of candidates whose true positions are known, and which of them are loops: up to `loop_m` apart.

    Those between that and 20 m are left out.
    """
    apart = np.array([np.linalg.norm(positions[one.query] - positions[one.match]) for one in candidates])
    clear = (apart <= loop_m) | (apart > NEGATIVE_M)
    chosen = [one.evidence for one, kept in zip(candidates, clear, strict=True) if kept]
    return Evidence.stack(chosen), apart[clear] <= loop_m


def _kept(image: Num[np.ndarray, "h w"]) -> UInt8[np.ndarray, "n n"]:
    """The middle square of an image on even cells, on the scale of 8 bits."""
    even = even_cells(jnp.asarray(image, jnp.float32))
    size = min(even.shape)
    grey = np.asarray(centre_crop(even, height=size, width=size)) * (255 / MAX_COUNT)
    return np.round(grey).clip(0, 255).astype(np.uint8)


def square_image(record: Record) -> UInt8[np.ndarray, "n n"]:
    """The image of a scan that loops are verified on: its density image, or the ready-made one, as 8 bits."""
    return _kept(picture(record, None)[0])
