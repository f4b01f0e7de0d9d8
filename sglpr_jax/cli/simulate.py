"""bin/simulate: write simulated drives in KITTI's layout."""

import dataclasses
from pathlib import Path

import tyro

from sglpr_jax.cli.datasets import SIMULATED, SIMULATED_AZIMUTH_STEPS, SIMULATED_SCANS, simulate
from sglpr_jax.cli.runtime import run


@dataclasses.dataclass(frozen=True)
class SimulateCommand:
    """Drive a simulated 64-beam LiDAR through a simulated town; write scans, labels, poses and times.

    Example: bin/simulate --out town --scans 300 --seed 0
    """

    out: Path
    """The dataset's folder; an interrupted one is completed."""
    seq: tuple[str, ...] = SIMULATED
    """Which drives: 00 and 05 revisit places in the same direction, 08 in the opposite one."""
    scans: int = SIMULATED_SCANS
    """Scans of each drive."""
    azimuth_steps: int = SIMULATED_AZIMUTH_STEPS
    """Firings per turn; the real sensor has about 1800."""
    seed: int = 0


def simulate_drives(command: SimulateCommand) -> Path:
    """Do what the command says; returns the dataset's folder."""
    simulate(
        command.out, scans=command.scans, azimuth_steps=command.azimuth_steps, seed=command.seed, names=command.seq
    )
    print(f"{command.out}: drives {', '.join(command.seq)}")
    return command.out


def main() -> None:
    """The entry point."""
    run(lambda: simulate_drives(tyro.cli(SimulateCommand, prog="simulate")))


if __name__ == "__main__":
    main()
