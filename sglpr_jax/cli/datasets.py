"""Which drives a command works on: those of a named dataset, or the simulated ones."""

import dataclasses
import sys
from collections.abc import Sequence as Many
from pathlib import Path

from sglpr_jax.cli.runtime import cache_folder, progress_bar
from sglpr_jax.data import Drive, open_sequence, sequence_names
from sglpr_jax.data.kitti import PoseChoice
from sglpr_jax.sim import write_dataset
from sglpr_jax.sim.sensor import HDL64E, Sensor

SIMULATED = ("00", "05", "08")
SIMULATED_SCANS = 300
SIMULATED_AZIMUTH_STEPS = 900
MEGABYTES_PER_SCAN = 1.03


def dataset_root(data: Path | None) -> Path:
    """The dataset's folder; without one, the simulated drives, made on first use and kept in the user's cache."""
    if data is not None:
        return data
    root = cache_folder() / f"simulated-{SIMULATED_SCANS}x{SIMULATED_AZIMUTH_STEPS}-seed0"
    print(
        f"no dataset named: using the simulated drives in {root} "
        "(for real KITTI: --data FOLDER, which holds sequences/NN/velodyne)",
        file=sys.stderr,
    )
    simulate(root, scans=SIMULATED_SCANS, azimuth_steps=SIMULATED_AZIMUTH_STEPS, seed=0)
    return root


def simulate(
    root: Path, *, scans: int, azimuth_steps: int, seed: int, names: Many[str] = SIMULATED, base: Sensor = HDL64E
) -> None:
    """Write what is missing of a simulated dataset, with its size said beforehand and its progress shown."""
    unfinished = [name for name in names if not (root / "sequences" / name / "poses.txt").exists()]
    if unfinished:
        size = MEGABYTES_PER_SCAN * azimuth_steps / SIMULATED_AZIMUTH_STEPS * scans * len(unfinished)
        print(f"simulating {len(unfinished)} drives of {scans} scans, about {size:.0f} MB", file=sys.stderr)
    sensor = dataclasses.replace(base, azimuth_steps=azimuth_steps)
    with progress_bar("simulate", scans * len(names)) as show:
        write_dataset(
            root,
            names=names,
            scans=scans,
            sensor=sensor,
            seed=seed,
            progress=lambda name, done, _: show(list(names).index(name) * scans + done),
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
