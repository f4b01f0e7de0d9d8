"""Simulated recordings on which the networks of other publications are trained, chosen and scored.

`train` has towns, two of them seen by three sensors and from two lines, and a car park and a garage, whose places
repeat. The learning rates are chosen on `held-out`. `test` has towns that no weights have seen, with several sensors
and sceneries, one town from two lines, one on two days, and two walks.
`train-images` has the images of the scans of `train`, for the presets of `bin/train`, which rotate images.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import tyro
from jaxtyping import Int

import sglpr_jax
from sglpr_jax.bev import uncrop_labels
from sglpr_jax.data.density_image import values_of_points
from sglpr_jax.data.readers import open_recording, recording_names
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scan import Scan
from sglpr_jax.files import replacing
from sglpr_jax.grid import DENSITY_SIZE
from sglpr_jax.labels import to_raw
from sglpr_jax.retrieval.image_maps import semantic_map
from sglpr_jax.sim.dataset import simulate

TRAIN, TRAIN_IMAGES, HELD_OUT, TEST = "train", "train-images", "held-out", "test"
TOWN = "town-601"
"""Test recordings that are also scored with rotated scans, and on which times are measured."""
BUILDING = 50
"""The label of all points without labels: raw id of SemanticKITTI."""
LINKED = ("velodyne", "poses.txt", "times.txt", "calib.txt")

Labels = Callable[[Scan], Int[np.ndarray, " n"]]


class Dataset(NamedTuple):
    """Folder of recordings, and the options of `simulate` that write it."""

    part: str
    name: str
    options: dict[str, Any]

    def folder(self, root: Path) -> Path:
        """Path of the dataset."""
        return root / self.part / self.name


def _town(part: str, seed: int, *routes: str, **options: Any) -> Dataset:
    aside = f"aside-{options['aside_m']:g}" if "aside_m" in options else "town"
    kind = options.get("scenery", options.get("sensor", aside))
    return Dataset(part, f"{kind}-{seed}", {"seed": seed, "routes": routes, **options})


_TRAIN = (
    *(_town(TRAIN, seed, "00", "02", "05", "06", "08") for seed in (10, 11, 12, 13)),
    *(_town(TRAIN, seed, "00", "08", sensor=sensor) for seed in (10, 11, 61) for sensor in ("vlp16", "os1-64")),
    *(_town(TRAIN, seed, "00", "08", aside_m=2.5) for seed in (10, 11)),
    *(_town(TRAIN, 11, "00", "08", scenery=scenery) for scenery in ("car_park", "garage")),
)
DATASETS = (
    *_TRAIN,
    *(Dataset(TRAIN_IMAGES, one.name, {**one.options, "images": True}) for one in _TRAIN),
    _town(HELD_OUT, 37, "00", "08"),
    _town(TEST, 601, "00", "08"),
    _town(TEST, 601, "00", "08", aside_m=3.0),
    *(_town(TEST, 602, "08", scenery=scenery) for scenery in ("outskirts", "lanes", "car_park")),
    *(_town(TEST, 603, "08", sensor=sensor) for sensor in ("vlp16", "os1-64", "xt32")),
    *(_town(TEST, 605, "08", scenery=scenery, carrier="backpack", sensor="os1-64") for scenery in ("campus", "yard")),
    Dataset(TEST, "days-604", {"seed": 604, "sessions": ("2012-01-15", "2012-02-04")}),
)


def folders(root: Path, part: str) -> list[Path]:
    """Return the written datasets of a part. Raises FileNotFoundError if there are none."""
    found = [one.folder(root) for one in DATASETS if one.part == part and one.folder(root).is_dir()]
    if not found:
        raise FileNotFoundError(f"{root / part}: expected datasets of `learned data`, found none")
    return found


def data(
    *, out: Path = Path("build/learned"), only: Sequence[str] = (), scans: int = 300, azimuth_steps: int = 900
) -> None:
    """Write the datasets, unless they exist.

    Args:
        out: folder of the parts.
        only: PART/NAME of the datasets to write; all if omitted.
        scans: of each recording.
        azimuth_steps: firings of a sensor per revolution.
    """
    for one in DATASETS:
        if not only or f"{one.part}/{one.name}" in only:
            print(simulate(one.folder(out), scans=scans, azimuth_steps=azimuth_steps, **one.options), flush=True)


def recordings_of(folder: Path) -> list[Recording]:
    """All recordings of a dataset."""
    return [open_recording(folder, name) for name in recording_names(folder)]


def labels(
    kind: tyro.conf.Positional[Literal["predicted", "none"]],
    *,
    data: Path = Path("build/learned"),
    out: Path | None = None,
    weights: str = "sglpr",
) -> None:
    """Write the recordings with other labels, unless they exist.

    Scans, times and poses are links to those of `data`. A predicted label is that of the point's cell in the semantic
    map, which reaches 25 m; points farther away have none. With "none", all points have one label. Sessions in NCLT's
    layout are left out: they have no labels.

    Args:
        kind: labels of `weights`, or none.
        data: folder of the recordings.
        out: folder of the recordings with other labels; build/learned-KIND if omitted.
        weights: weights with a segmentation head.
    """
    out = out or Path(f"build/learned-{kind}")
    params = sglpr_jax.load(weights)
    of_points = _unlabelled if kind == "none" else lambda scan: _predicted(params, scan)
    for part in (TRAIN, HELD_OUT, TEST):
        for folder in folders(data, part):
            if (folder / "sequences").is_dir():
                _relabel(folder, out / part / folder.name, of_points)
                print(out / part / folder.name, flush=True)


def _relabel(folder: Path, out: Path, labels: Labels) -> None:
    """Writes a copy of a dataset with labels from `labels`. All other files are links."""
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
                    labels(recording.scan(row, labels=False)).astype(np.uint32).tofile(temporary)


def _link(to: Path, path: Path) -> None:
    if to.exists() and not path.exists():
        path.symlink_to(to.absolute())


def _unlabelled(scan: Scan) -> Int[np.ndarray, " n"]:
    return np.full(len(scan.upright_points), BUILDING)


def _predicted(params: sglpr_jax.Params, scan: Scan) -> Int[np.ndarray, " n"]:
    """Return the raw label of each point's cell, 0 outside the map."""
    cells = uncrop_labels(semantic_map(params, scan).predicted, shape=(DENSITY_SIZE, DENSITY_SIZE))
    classes = values_of_points(np.rot90(cells), scan.upright_points)  # density_image is rotated by 90 degrees
    return to_raw(classes, categories=params.config.categories)
