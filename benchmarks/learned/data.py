"""Simulated recordings on which the networks of other publications are trained, chosen and scored.

    python -m benchmarks.learned.data --out build/learned

`train` has towns of the card of `sglpr` and car parks and garages, whose places repeat. The learning rates are chosen
on `held-out`. `test` has towns that no weights have seen, with several sensors and sceneries, and one town on two days.
`train-images` has the images of the scans of `train`, for the presets of `bin/train`, which rotate images.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import tyro

from sglpr_jax.sim.dataset import simulate

TRAIN, TRAIN_IMAGES, HELD_OUT, TEST = "train", "train-images", "held-out", "test"


class Dataset(NamedTuple):
    """A folder of recordings, and what makes it."""

    part: str
    name: str
    options: dict[str, Any]

    def folder(self, root: Path) -> Path:
        """Path of the dataset."""
        return root / self.part / self.name


def _town(part: str, seed: int, *routes: str, **options: Any) -> Dataset:
    kind = options.get("scenery", options.get("sensor", "town"))
    return Dataset(part, f"{kind}-{seed}", {"seed": seed, "routes": routes, **options})


_TRAIN = (
    *(_town(TRAIN, seed, "00", "02", "05", "06", "08") for seed in (10, 11, 12, 13)),
    *(_town(TRAIN, 61, "00", "08", sensor=sensor) for sensor in ("vlp16", "os1-64")),
    *(_town(TRAIN, 11, "00", "08", scenery=scenery) for scenery in ("car_park", "garage")),
)
DATASETS = (
    *_TRAIN,
    *(Dataset(TRAIN_IMAGES, one.name, {**one.options, "images": True}) for one in _TRAIN),
    _town(HELD_OUT, 37, "00", "08"),
    _town(TEST, 601, "00", "08"),
    *(_town(TEST, 602, "08", scenery=scenery) for scenery in ("outskirts", "lanes", "car_park")),
    *(_town(TEST, 603, "08", sensor=sensor) for sensor in ("vlp16", "os1-64")),
    Dataset(TEST, "days-604", {"seed": 604, "sessions": ("2012-01-15", "2012-02-04")}),
)


def folders(root: Path, part: str) -> list[Path]:
    """Return the written datasets of a part. Raises FileNotFoundError if there are none."""
    found = [one.folder(root) for one in DATASETS if one.part == part and one.folder(root).is_dir()]
    if not found:
        raise FileNotFoundError(f"{root / part}: expected datasets of benchmarks.learned.data, found none")
    return found


def main(
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
            folder = one.folder(out)
            folder.parent.mkdir(parents=True, exist_ok=True)
            print(simulate(folder, scans=scans, azimuth_steps=azimuth_steps, **one.options), flush=True)


if __name__ == "__main__":
    tyro.cli(main)
