"""bin/simulate: write simulated drives in KITTI's layout, as images in BEVPlace's, or several days in NCLT's."""

import dataclasses
from pathlib import Path

from sglpr_jax.sim import SCANS

WITH_TRAINING_SET = ("out", "training_set", "scans")
"""Flags that may accompany --training-set."""


@dataclasses.dataclass(frozen=True)
class SimulateCommand:
    """Drive a simulated LiDAR through simulated towns. Write scans, labels, poses, calibration and times.

    Example:
      bin/simulate --out towns --seq 08 --scans 400 --sensor hdl64e --seed 0
      bin/simulate --out days --sessions 2012-01-15 2012-02-04 2012-03-17 --scans 400
      bin/simulate --out TOWNS --training-set
    """

    out: Path
    """Folder of the dataset. An interrupted dataset is completed, and recordings can be added."""
    training_set: bool = False
    """Write the training set of the preset `sglpr`: datasets of images, each in its own folder of --out. Their
    recordings are called DATASET/NN. --scans is the only other flag."""
    seq: tuple[str, ...] | None = None
    """Routes, from 00 to 10. Their revisits resemble KITTI's: same direction in 00, 02, 05, 06, 07 and 09, opposite
    direction in 08, no revisits in the others. None: 00 05 08, where places repeat 01 06 08, or no routes with
    --along."""
    along: tuple[Path, ...] = ()
    """KITTI pose files to drive along, each through its own town. Every k-th line is used, for at most --scans
    scans."""
    sessions: tuple[str, ...] = ()
    """Dates: one town on several days, in NCLT's layout. The first day drives one route of --seq (00). The others drive
    the same streets, partly in the opposite direction, with other parked cars and traffic."""
    scans: int = SCANS
    """Scans of each recording."""
    rate_hz: float | None = None
    """Scans per second of a route. KITTI's rate is 10. None: 4 in towns, elsewhere the rate of the
    carrier or of the scenery."""
    sensor: str | None = None
    """LiDAR: hdl64e (KITTI's), hdl32e, hdl32e-nclt (NCLT's, upside down), vlp16, xt32, os0-32, os1-64, m1, mid360 or
    avia. None: hdl64e, or hdl32e-nclt for --sessions."""
    azimuth_steps: int | None = None
    """Firings per revolution. Fewer firings make smaller files. None: the number of the real sensor."""
    scenery: str = "town"
    """Surroundings of the drive: `town`; `outskirts`, hilly, with long roads between walls, hedges and slopes; `lanes`,
    roads between overgrown hedges; or `gardens`, streets with front gardens, low fences and old trees. Surroundings
    where places repeat, such as `forest`, are possible, too. There, a route stands only for the direction of its
    revisits."""
    carrier: str = "vehicle"
    """Carrier of the sensor: `vehicle`, `backpack`, `handheld`, `cart`, or `stop-and-reverse`, a car that sometimes
    stands or reverses. In towns, only height and sway are those of the carrier. Not with --sessions."""
    aside_m: float = 0.0
    """Distance of the drive to the left of its usual line, in metres, as on another lane. The town stays the same, so
    that two datasets show its places from both lines. Not with --sessions."""
    submap_m: float = 0.0
    """Travelled distance of submaps, in metres. 0 writes scans."""
    images: bool = False
    """Write BEV density images with label images (NN/imgs, NN/labels, NN/pose.txt) instead of scans and labels."""
    vary: bool = False
    """With --images: rotate every scan about z and remove points from most scans before the image is made. For
    training."""
    seed: int = 0
    """Seed of the towns and drives."""


def write_simulation(command: SimulateCommand) -> None:
    from sglpr_jax.cli.datasets import simulate  # slow imports, not needed for --help
    from sglpr_jax.sim.training_set import training_set

    options = {field.name: getattr(command, field.name) for field in dataclasses.fields(command)}
    out = options.pop("out")
    if options.pop("training_set"):
        _require_defaults(command)
        for name, dataset in training_set().items():
            print(simulate(out / name, scans=command.scans, **dataset))
    else:
        print(simulate(out, routes=options.pop("seq"), **options))


def _require_defaults(command: SimulateCommand) -> None:
    """Raise ValueError if a flag is set that --training-set sets itself."""
    fields = (field for field in dataclasses.fields(command) if field.name not in WITH_TRAINING_SET)
    found = [field.name.replace("_", "-") for field in fields if getattr(command, field.name) != field.default]
    if found:
        raise ValueError(f"with --training-set, expected no other flag than --scans, found --{found[0]}")
