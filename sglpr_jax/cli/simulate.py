"""bin/simulate: write simulated drives in KITTI's layout, or as images in BEVPlace's."""

import dataclasses
from pathlib import Path

import tyro

from sglpr_jax.cli.datasets import SIMULATED, SIMULATED_SCANS, simulate
from sglpr_jax.cli.runtime import run
from sglpr_jax.sim.drive import RATE_HZ, name_of_path


@dataclasses.dataclass(frozen=True)
class SimulateCommand:
    """Drive a simulated LiDAR through simulated towns; write scans, labels, poses, calibration and times.

    Example: bin/simulate --out towns --seq 08 --scans 400 --sensor hdl64e --seed 0
    """

    out: Path
    """The dataset's folder; an interrupted one is completed, and drives can be added."""
    seq: tuple[str, ...] | None = None
    """Which routes, of 00 to 10. Their revisits are like KITTI's: 00, 02, 05, 06, 07 and 09 have them in the same
    direction, 08 in the opposite one, the others none. None: 00 05 08, or none where --along is given."""
    along: tuple[Path, ...] = ()
    """KITTI pose files to drive along, each through a town of its own; every k-th line, to have at most --scans."""
    scans: int = SIMULATED_SCANS
    """Scans of each drive."""
    rate_hz: float = RATE_HZ
    """Scans per second of a route; KITTI's rate is 10."""
    sensor: str = "hdl64e"
    """The LiDAR: hdl64e (KITTI's), hdl32e or vlp16."""
    azimuth_steps: int | None = None
    """Firings per turn; fewer make smaller files. None: as many as the real sensor's."""
    images: bool = False
    """Write BEV density images (NN/imgs, NN/pose.txt) in place of scans and labels."""
    seed: int = 0


def simulate_drives(command: SimulateCommand) -> Path:
    """Do what the command says; returns the dataset's folder."""
    names = command.seq if command.seq is not None else () if command.along else SIMULATED
    simulate(
        command.out,
        names=names,
        along=command.along,
        scans=command.scans,
        sensor=command.sensor,
        azimuth_steps=command.azimuth_steps,
        seed=command.seed,
        rate_hz=command.rate_hz,
        images=command.images,
    )
    print(f"{command.out}: drives {', '.join([*names, *map(name_of_path, command.along)])}")
    return command.out


def main() -> None:
    """The entry point."""
    run(lambda: simulate_drives(tyro.cli(SimulateCommand, prog="simulate")))


if __name__ == "__main__":
    main()
