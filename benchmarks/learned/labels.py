"""The recordings of `data` with other labels: those that `sglpr` predicts, or one and the same for all points.

    python -m benchmarks.learned.labels predicted --data build/learned --out build/learned-predicted
    python -m benchmarks.learned.labels none --data build/learned --out build/learned-none

The scans, times and poses are links to those of `data`. A predicted label is that of the point's cell in the semantic
map, which reaches 25 m. Points farther away have none. Sessions in NCLT's layout are left out: they have no labels.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
from jaxtyping import Int

import sglpr_jax
from benchmarks.learned.data import HELD_OUT, TEST, TRAIN, folders
from sglpr_jax.bev import uncropped
from sglpr_jax.data.density_grid import SIZE
from sglpr_jax.data.density_image import values_of_points
from sglpr_jax.data.readers import open_recording, recording_names
from sglpr_jax.data.recording import Record
from sglpr_jax.files import replacing
from sglpr_jax.labels import to_raw
from sglpr_jax.retrieval.image_maps import semantic_map

BUILDING = 50
"""The label of all points without labels: raw id of SemanticKITTI."""
LINKED = ("velodyne", "poses.txt", "times.txt", "calib.txt")

Labels = Callable[[Record], Int[np.ndarray, " n"]]


def main(
    kind: tyro.conf.Positional[Literal["predicted", "none"]],
    *,
    data: Path = Path("build/learned"),
    out: Path = Path("build/learned-predicted"),
    weights: str = "sglpr",
) -> None:
    """Write the labels, unless they exist.

    Args:
        kind: labels of `weights`, or none.
        data: folder of the recordings.
        out: folder of the recordings with other labels.
        weights: weights with a segmentation head.
    """
    params = sglpr_jax.load(weights)
    labels = _unlabelled if kind == "none" else lambda record: _predicted(params, record)
    for part in (TRAIN, HELD_OUT, TEST):
        for folder in folders(data, part):
            if (folder / "sequences").is_dir():
                _relabel(folder, out / part / folder.name, labels)
                print(out / part / folder.name, flush=True)


def _relabel(folder: Path, out: Path, labels: Labels) -> None:
    """Link a dataset, with labels of its own."""
    out.mkdir(parents=True, exist_ok=True)
    _link(folder / "simulation.json", out / "simulation.json")
    for name in recording_names(folder):
        recording, there = open_recording(folder, name), out / "sequences" / name
        (there / "labels").mkdir(parents=True, exist_ok=True)
        for linked in LINKED:
            _link(folder / "sequences" / name / linked, there / linked)
        for row, scan in enumerate(recording.ids):
            path = there / "labels" / f"{scan}.label"
            if not path.exists():
                with replacing(path) as temporary:
                    labels(recording.record(row, labels=False)).astype(np.uint32).tofile(temporary)


def _link(to: Path, path: Path) -> None:
    if to.exists() and not path.exists():
        path.symlink_to(to.absolute())


def _unlabelled(record: Record) -> Int[np.ndarray, " n"]:
    return np.full(len(record.upright_points), BUILDING)


def _predicted(params: sglpr_jax.Params, record: Record) -> Int[np.ndarray, " n"]:
    """Return the raw label of each point's cell, 0 outside the map."""
    cells = uncropped(semantic_map(params, record).predicted, shape=(SIZE, SIZE))
    classes = values_of_points(np.rot90(cells), record.upright_points)  # density_image is rotated by 90 degrees
    return to_raw(classes, categories=params.config.categories)


if __name__ == "__main__":
    tyro.cli(main)
