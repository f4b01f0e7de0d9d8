"""What the page shows of the dataset and the model: pictures of scans, semantic maps, feature heat maps."""

from collections.abc import Mapping, Sequence

import numpy as np

from sglpr_jax.bev import Grid
from sglpr_jax.data import Drive, ScanSequence
from sglpr_jax.evaluation.false_positives import FalsePositive
from sglpr_jax.evaluation.inputs import Input
from sglpr_jax.evaluation.page import HeatPicture, Pictures, SemanticPicture
from sglpr_jax.models.presets import model_preset
from sglpr_jax.models.sglpr import Params
from sglpr_jax.retrieval.descriptor_file import DescriptorFile
from sglpr_jax.retrieval.embed import read_image, read_views
from sglpr_jax.retrieval.heat_maps import heat_maps
from sglpr_jax.retrieval.semantic_maps import read_semantic_map

SHOWN = (1 / 3, 2 / 3)
"""How far along the drive the scans are whose maps are shown."""


def take_pictures(sequence: Drive, params: Params | None, source: Input, worst: Sequence[FalsePositive]) -> Pictures:
    """Return pictures of the false positives, and with `params` maps of two scans of the sequence.

    Raises ValueError where the frames of `source` are not those of the sequence.
    """
    rows = sequence_rows(sequence, source)
    frames = sorted({frame for found in worst for frame in (found.query, found.answer)})
    images = {frame: _image(sequence, rows[frame], model_preset("small").grid) for frame in frames}
    if params is None:
        needs = "maps: add --weights beside --data."
        return Pictures(images, f"Semantic {needs}", f"Feature heat {needs}")
    shown = sorted({int(part * len(sequence)) for part in SHOWN})
    heat = {sequence.ids[row]: _heat(sequence, params, row) for row in shown}
    if not params.config.segments:
        return Pictures(images, "Semantic maps: add --weights that have a segmentation head; these have none.", heat)
    return Pictures(images, {sequence.ids[row]: semantic_picture(sequence, params, row) for row in shown}, heat)


def sequence_rows(sequence: Drive, source: Input) -> Mapping[int, int]:
    """Return the row in the sequence of each frame of `source`: by its id, or by its number where both have as many.

    Raises ValueError where neither serves.
    """
    n = len(sequence) if source.positions is None else len(source.positions)
    row_of = {name: row for row, name in enumerate(sequence.ids)}
    if isinstance(source, DescriptorFile) and set(source.ids) <= set(row_of):
        return {frame: row_of[name] for frame, name in enumerate(source.ids)}
    if n != len(sequence):
        raise ValueError(f"--data: expected {n} frames in sequence {sequence.name}, as scored, found {len(sequence)}")
    return {frame: frame for frame in range(n)}


def _image(sequence: Drive, row: int, grid: Grid) -> np.ndarray:
    """Ready-made images come whole; scans are rasterised on `grid`."""
    return np.asarray(read_image(sequence, row, grid if isinstance(sequence, ScanSequence) else None))


def _heat(sequence: Drive, params: Params, row: int) -> HeatPicture:
    config = params.config
    views = read_views(sequence, row, config.grid, categories=config.categories_read, image=config.image)
    return HeatPicture(np.asarray(views[0]), heat_maps(params, *views))


def semantic_picture(sequence: Drive, params: Params, row: int) -> SemanticPicture:
    """Return one scan's counts and semantic maps: the network's and, with labels, the true one."""
    config, found = params.config, read_semantic_map(params, sequence, row)
    truth = None if sequence.label_paths[row] is None else found.truth
    return SemanticPicture(found.counts, truth, found.predicted, config.grid.resolution_m, config.categories)
