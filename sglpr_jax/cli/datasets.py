"""Which drives a command works on: those of a named dataset, or the simulated ones."""

import dataclasses
import sys
from collections.abc import Sequence as Many
from pathlib import Path

from sglpr_jax.cli.runtime import cache_folder, progress_bar
from sglpr_jax.data import Drive, open_sequence, sequence_names
from sglpr_jax.data.kitti import PoseChoice
from sglpr_jax.sim import SENSORS, Sensor, write_dataset, write_sessions
from sglpr_jax.sim.dataset import VERSION
from sglpr_jax.sim.drive import RATE_HZ, name_of_path
from sglpr_jax.sim.layouts import LAYOUTS

SIMULATED = ("00", "05", "08")
SIMULATED_DAYS = ("2012-01-15", "2012-02-04", "2012-03-17")
SIMULATED_SCANS = 300
SIMULATED_AZIMUTH_STEPS = 900
BYTES_PER_RAY = 16
"""Of a scan and its labels: 20 for every return, and most rays return."""
BYTES_PER_NCLT_RAY = 5
"""Of 8 for every return; many rays go into the sky."""
BYTES_PER_IMAGE = 3500
"""With its label map."""


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


def cached_sessions() -> Path:
    """The folder of the simulated sessions in NCLT's layout, made on first use and kept in the user's cache."""
    root = cache_folder() / f"sessions-v{VERSION}-{SIMULATED_SCANS}x{SIMULATED_AZIMUTH_STEPS}-seed0"
    print(f"no sessions named: using the simulated ones in {root} (for real NCLT: --nclt FOLDER)", file=sys.stderr)
    simulate_days(
        root,
        dates=SIMULATED_DAYS,
        route="00",
        scans=SIMULATED_SCANS,
        sensor="hdl32e-nclt",
        azimuth_steps=SIMULATED_AZIMUTH_STEPS,
        seed=0,
        rate_hz=RATE_HZ,
    )
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
    lidar = _lidar(sensor, azimuth_steps)
    layout = "images" if images else "scans"
    drives = [*names, *map(name_of_path, along)]
    _announce(root, drives, layout, scans=scans, bytes_each=BYTES_PER_IMAGE if images else BYTES_PER_RAY * _rays(lidar))
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


def simulate_days(
    root: Path,
    *,
    dates: Many[str],
    route: str,
    scans: int,
    sensor: str,
    azimuth_steps: int | None,
    seed: int,
    rate_hz: float,
) -> None:
    """Write what is missing of one simulated town on several days, in NCLT's layout; otherwise as `simulate`."""
    lidar = _lidar(sensor, azimuth_steps)
    _announce(root, dates, "nclt", scans=scans, bytes_each=BYTES_PER_NCLT_RAY * _rays(lidar))
    with progress_bar("simulate", scans * len(dates)) as show:
        write_sessions(
            root,
            dates=dates,
            route=route,
            scans=scans,
            sensor=lidar,
            seed=seed,
            rate_hz=rate_hz,
            progress=lambda date, done, _: show(dates.index(date) * scans + done),
        )


def _lidar(sensor: str, azimuth_steps: int | None) -> Sensor:
    if sensor not in SENSORS:
        raise ValueError(f"expected a sensor among {', '.join(SENSORS)}, found {sensor!r}")
    lidar = SENSORS[sensor]
    return lidar if azimuth_steps is None else dataclasses.replace(lidar, azimuth_steps=azimuth_steps)


def _rays(lidar: Sensor) -> int:
    return len(lidar.elevations_deg) * lidar.azimuth_steps


def _announce(root: Path, drives: Many[str], layout: str, *, scans: int, bytes_each: int) -> None:
    """Say how much there is to write, if anything."""
    unfinished = [name for name in drives if not LAYOUTS[layout].is_finished(root, name)]
    if unfinished:
        size, what = bytes_each * scans * len(unfinished) / 1e6, "images" if layout == "images" else "scans"
        print(f"simulating {len(unfinished)} drives of {scans} {what}, about {size:.0f} MB", file=sys.stderr)


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
    _require_positions(root, [*drives, test])
    print(f"training on {', '.join(names)}; testing on {seq}, never seen", file=sys.stderr)
    return drives, test


def all_drives(root: Path, *, poses: PoseChoice = "auto") -> list[Drive]:
    """Every drive of a dataset that is trained on beside another. Errors as of `leave_one_out`."""
    drives = [open_sequence(root, name, poses=poses) for name in sequence_names(root)]
    _require_positions(root, drives)
    print(f"training on {', '.join(drive.name for drive in drives)} of {root} too", file=sys.stderr)
    return drives


def _require_positions(root: Path, drives: Many[Drive]) -> None:
    for drive in drives:
        if drive.positions is None:
            raise ValueError(f"{root}: sequence {drive.name} has no poses; training and testing need them")
