"""bin/simulate: write simulated drives in KITTI's layout, as images in BEVPlace's, or several days in NCLT's."""

import dataclasses
from pathlib import Path

from sglpr_jax.cli.runtime import parse_command, run
from sglpr_jax.sim.choices import RATE_HZ, SCANS


@dataclasses.dataclass(frozen=True)
class SimulateCommand:
    """Drive a simulated LiDAR through simulated towns; write scans, labels, poses, calibration and times.

    Examples:
      bin/simulate --out towns --seq 08 --scans 400 --sensor hdl64e --seed 0
      bin/simulate --out days --sessions 2012-01-15 2012-02-04 2012-03-17 --scans 400
    """

    out: Path
    """The dataset's folder; an interrupted one is completed, and recordings can be added."""
    seq: tuple[str, ...] | None = None
    """Which routes, of 00 to 10. Their revisits are like KITTI's: 00, 02, 05, 06, 07 and 09 have them in the same
    direction, 08 in the opposite one, the others none. None: 00 05 08, or none where --along is given."""
    along: tuple[Path, ...] = ()
    """KITTI pose files to drive along, each through a town of its own; every k-th line, to have at most --scans."""
    sessions: tuple[str, ...] = ()
    """Dates: one town on so many days, in NCLT's layout. The first drives one route of --seq (00), the others the same
    streets, partly the other way; parked cars and traffic are other ones."""
    scans: int = SCANS
    """Scans of each recording."""
    rate_hz: float = RATE_HZ
    """Scans per second of a route; KITTI's rate is 10."""
    sensor: str | None = None
    """The LiDAR: hdl64e (KITTI's), hdl32e, hdl32e-nclt (NCLT's, upside down), vlp16, xt32 or os1-64. None: hdl64e, or
    hdl32e-nclt for --sessions."""
    azimuth_steps: int | None = None
    """Firings per turn; fewer make smaller files. None: as many as the real sensor's."""
    scenery: str = "town"
    """The land: `town`; `outskirts`, hilly, with long roads between walls, hedges and slopes; `lanes`, roads between
    overgrown hedges; or `gardens`, streets with front gardens, low fences and old trees."""
    images: bool = False
    """Write BEV density images with label images (NN/imgs, NN/labels, NN/pose.txt) in place of scans and labels."""
    vary: bool = False
    """With --images: rotate every scan about z, and take points from most, before it becomes an image. For training."""
    seed: int = 0


def write_simulation(command: SimulateCommand) -> Path:
    """Do what the command says; returns the dataset's folder."""
    from sglpr_jax.cli.datasets import simulate  # this brings JAX and more, which --help does not need

    options = {field.name: getattr(command, field.name) for field in dataclasses.fields(command)}
    print(simulate(options.pop("out"), routes=options.pop("seq"), **options))
    return command.out


def main() -> None:
    """The entry point."""
    run(lambda: parse_command(SimulateCommand, "simulate"), write_simulation)


if __name__ == "__main__":
    main()
