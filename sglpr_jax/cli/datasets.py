"""Which drives a command works on: those of a named dataset, or the simulated ones."""

import dataclasses
import sys
from collections.abc import Sequence as Many
from pathlib import Path

from sglpr_jax.cli.runtime import cache_folder, progress_bar
from sglpr_jax.data import Drive, open_sequence, sequence_names
from sglpr_jax.data.kitti import PoseChoice
from sglpr_jax.sim import SENSORS, write_dataset
from sglpr_jax.sim.dataset import VERSION
from sglpr_jax.sim.drive import RATE_HZ, name_of_path
from sglpr_jax.sim.layouts import LAYOUTS

SIMULATED = ("00", "05", "08")
SIMULATED_SCANS = 300
SIMULATED_AZIMUTH_STEPS = 900
BYTES_PER_RAY = 16
"""Of a scan and its labels: 20 for every return, and most rays return."""
BYTES_PER_IMAGE = 2000


def dataset_root(data: Path | None) -> Path:
    """The dataset's folder; without one, the simulated drives, made on first use and kept in the user's cache."""
    if data is not None:
        return data
    root = cache_folder() / f"simulated-v{VERSION}-{SIMULATED_SCANS}x{SIMULATED_AZIMUTH_STEPS}-seed0"
    print(
        f"no dataset named: using the simulated drives in {root} "
        "(for real KITTI: --data FOLDER, which holds sequences/NN/velodyne)",
        file=sys.stderr,
    )
    simulate(root, scans=SIMULATED_SCANS, azimuth_steps=SIMULATED_AZIMUTH_STEPS, seed=0)
    return root


def simulate(
    root: Path,
    *,
    names: Many[str] = SIMULATED,
    along: Many[Path] = (),
    scans: int,
    sensor: str = "hdl64e",
    azimuth_steps: int | None = None,
    seed: int,
    rate_hz: float = RATE_HZ,
    images: bool = False,
) -> None:
    """Write what is missing of a simulated dataset, with its size said beforehand and its progress shown.

    Raises ValueError for an unknown sensor; for the other errors see `write_dataset`.
    """
    if sensor not in SENSORS:
        raise ValueError(f"expected a sensor among {', '.join(SENSORS)}, found {sensor!r}")
    lidar = SENSORS[sensor]
    lidar = lidar if azimuth_steps is None else dataclasses.replace(lidar, azimuth_steps=azimuth_steps)
    layout = "images" if images else "scans"
    drives = [*names, *map(name_of_path, along)]
    unfinished = [name for name in drives if not LAYOUTS[layout].is_finished(root, name)]
    if unfinished:
        rays = len(lidar.elevations_deg) * lidar.azimuth_steps
        size = (BYTES_PER_IMAGE if images else BYTES_PER_RAY * rays) * scans * len(unfinished) / 1e6
        print(f"simulating {len(unfinished)} drives of {scans} {layout}, about {size:.0f} MB", file=sys.stderr)
    with progress_bar("simulate", scans * len(drives)) as show:
        write_dataset(
            root,
            names=names,
            along=along,
            scans=scans,
            sensor=lidar,
            seed=seed,
            rate_hz=rate_hz,
            layout=layout,
            progress=lambda name, done, count: show(drives.index(name) * scans + done * scans // count),
        )


def leave_one_out(
    root: Path, seq: str, *, train_seqs: Many[str] = (), poses: PoseChoice = "auto"
) -> tuple[list[Drive], Drive]:
    """The drives to train on (all but `seq`, or those named) and the one to test on.

    Raises FileNotFoundError for a drive that does not exist, ValueError where the test drive would be trained on,
    nothing is left to train on, or a drive has no positions.
    """
    test = open_sequence(root, seq, poses=poses)
    names = tuple(train_seqs) or tuple(name for name in sequence_names(root) if name != seq)
    if not names or seq in names:
        raise ValueError(f"{root}: expected drives to train on other than {seq!r}, found {', '.join(names) or 'none'}")
    drives = [open_sequence(root, name, poses=poses) for name in names]
    for drive in (*drives, test):
        if drive.positions is None:
            raise ValueError(f"{root}: sequence {drive.name} has no poses; training and testing need them")
    print(f"training on {', '.join(names)}; testing on {seq}, never seen", file=sys.stderr)
    return drives, test
