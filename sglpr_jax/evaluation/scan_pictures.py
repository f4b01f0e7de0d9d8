"""Pictures for the page of an evaluation, from a dataset and a model: scans, semantic maps and feature heat maps."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Num

from sglpr_jax.data.formats.pose_files import Trajectory
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.views import view
from sglpr_jax.evaluation import figures
from sglpr_jax.evaluation.inputs import Input
from sglpr_jax.evaluation.scoring import FalsePositive
from sglpr_jax.models.config import model_preset
from sglpr_jax.models.params import Params
from sglpr_jax.retrieval.descriptor_file import DescriptorFile
from sglpr_jax.retrieval.image_maps import heat_maps, semantic_map

if TYPE_CHECKING:
    import matplotlib.figure

SHOWN = (1 / 3, 2 / 3)
"""Positions of the shown scans, as fractions of the recording."""


@dataclass(frozen=True, eq=False)
class Pictures:
    """Pictures of a page, by frame. A string instead of figures says what adds them."""

    images: Mapping[int, Num[np.ndarray, "_ _"]] = field(default_factory=dict)
    """Point counts of the queries and answers of false positives, by frame number."""
    semantic: "Mapping[str, matplotlib.figure.Figure] | str" = "Semantic maps: add --weights and --data."
    heat: "Mapping[str, matplotlib.figure.Figure] | str" = "Feature heat maps: add --weights and --data."


def take_pictures(
    recording: Recording, params: Params | None, source: Input, worst: Sequence[FalsePositive]
) -> Pictures:
    """Return images of the false positives and, with `params`, maps of two scans of the recording.

    Raises ValueError if `source` and the recording have different frames.
    """
    rows = recording_rows(recording, source)
    grid = None if recording.has_images else model_preset("sglpr").grid  # ready-made images are not cropped
    images = {
        frame: np.asarray(view(recording.record(rows[frame], labels=False), grid).image)
        for frame in sorted({frame for found in worst for frame in (found.query, found.answer)})
    }
    if params is None:
        needs = "maps: add --weights beside --data."
        return Pictures(images, f"Semantic {needs}", f"Feature heat {needs}")
    if not figures.can_draw():
        return Pictures(images)
    shown = sorted({int(part * len(recording)) for part in SHOWN})
    heat = {recording.ids[row]: _heat_figure(recording, params, row) for row in shown}
    if not params.config.segments:
        return Pictures(images, "Semantic maps: add --weights that have a segmentation head; these have none.", heat)
    return Pictures(images, {recording.ids[row]: semantic_figure(recording, params, row) for row in shown}, heat)


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


def semantic_figure(recording: Recording, params: Params, row: int, *, title: str = "") -> "matplotlib.figure.Figure":
    """Draw point counts and predicted semantic map of a scan, and the true map if the scan has labels (figure 7)."""
    config, found = params.config, semantic_map(params, recording.record(row))
    return figures.segmentation_panel(
        found.counts,
        found.truth if recording.labelled[row] else None,
        found.predicted,
        resolution_m=config.grid.resolution_m,
        categories=config.categories,
        title=title,
    )


def _heat_figure(recording: Recording, params: Params, row: int) -> "matplotlib.figure.Figure":
    """Draw the activation of each layer of a network for a scan (figure 8)."""
    config = params.config
    record = recording.record(row, labels=bool(config.categories_read))
    seen = view(record, config.grid, categories=config.categories_read, image=config.image)
    return figures.heat_maps(np.asarray(seen.image), heat_maps(params, *seen))
