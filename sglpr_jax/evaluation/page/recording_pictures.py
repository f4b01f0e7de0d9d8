"""Images for a page from a dataset and a model: scans, semantic maps and feature heat maps."""

from collections.abc import Mapping, Sequence

import numpy as np

from sglpr_jax.data.formats.pose_files import Trajectory
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.views import view
from sglpr_jax.evaluation.false_positives import FalsePositive
from sglpr_jax.evaluation.inputs import Input
from sglpr_jax.evaluation.page import HeatPicture, Pictures, SemanticPicture
from sglpr_jax.grid import Grid
from sglpr_jax.models.config import model_preset
from sglpr_jax.models.params import Params
from sglpr_jax.retrieval.descriptor_file import DescriptorFile
from sglpr_jax.retrieval.image_maps import heat_maps, semantic_map

SHOWN = (1 / 3, 2 / 3)
"""Positions of the shown scans, as fractions of the recording."""


def take_pictures(
    recording: Recording, params: Params | None, source: Input, worst: Sequence[FalsePositive]
) -> Pictures:
    """Return images of the false positives and, with `params`, maps of two scans of the recording.

    Raises ValueError if `source` and the recording have different frames.
    """
    rows = recording_rows(recording, source)
    frames = sorted({frame for found in worst for frame in (found.query, found.answer)})
    images = {frame: _image(recording, rows[frame], model_preset("sglpr").grid) for frame in frames}
    if params is None:
        needs = "maps: add --weights beside --data."
        return Pictures(images, f"Semantic {needs}", f"Feature heat {needs}")
    shown = sorted({int(part * len(recording)) for part in SHOWN})
    heat = {recording.ids[row]: _heat(recording, params, row) for row in shown}
    if not params.config.segments:
        return Pictures(images, "Semantic maps: add --weights that have a segmentation head; these have none.", heat)
    return Pictures(images, {recording.ids[row]: semantic_picture(recording, params, row) for row in shown}, heat)


def check_same_frames(recording: Recording, source: Input) -> None:
    """Raise ValueError if `source` and the recording have different frames."""
    recording_rows(recording, source)


def poses_of(recording: Recording) -> Trajectory | None:
    """Return the positions and times of a recording, or None if it has no positions."""
    if recording.positions is None:
        return None
    return Trajectory(recording.positions, recording.times, recording.pose_source or recording.name)


def recording_rows(recording: Recording, source: Input) -> Mapping[int, int]:
    """Return the row in the recording of each frame of `source`.

    Frames are matched by id or, if ids do not match, by number. Raises ValueError if the numbers of frames differ, too.
    """
    n = len(recording) if source.positions is None else len(source.positions)
    row_of = {name: row for row, name in enumerate(recording.ids)}
    if isinstance(source, DescriptorFile) and set(source.ids) <= set(row_of):
        return {frame: row_of[name] for frame, name in enumerate(source.ids)}
    if n != len(recording):
        raise ValueError(
            f"--data: expected {n} frames in sequence {recording.name}, as in the input, found {len(recording)}"
        )
    return {frame: frame for frame in range(n)}


def _image(recording: Recording, row: int, grid: Grid) -> np.ndarray:
    """Return the image of a scan, rasterised on `grid`. Ready-made images are not cropped."""
    return np.asarray(view(recording.record(row, labels=False), None if recording.has_images else grid).image)


def _heat(recording: Recording, params: Params, row: int) -> HeatPicture:
    config = params.config
    record = recording.record(row, labels=bool(config.categories_read))
    seen = view(record, config.grid, categories=config.categories_read, image=config.image)
    return HeatPicture(np.asarray(seen.image), heat_maps(params, *seen))


def semantic_picture(recording: Recording, params: Params, row: int) -> SemanticPicture:
    """Return point counts and predicted semantic map of a scan, and the true map if the scan has labels."""
    config, found = params.config, semantic_map(params, recording.record(row))
    truth = found.truth if recording.labelled[row] else None
    return SemanticPicture(found.counts, truth, found.predicted, config.grid.resolution_m, config.categories)
