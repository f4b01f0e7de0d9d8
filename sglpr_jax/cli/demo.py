"""bin/demo: simulate a drive, find its loops and correct its trajectory, as bin/loops does with any scans."""

import dataclasses
import importlib.util
import shlex
import sys
from pathlib import Path

from sglpr_jax.cli.loops import LoopsCommand, check_flags, loops_of_recording
from sglpr_jax.cli.recording import AUTO
from sglpr_jax.cli.runtime import parse_command, with_installed_names

ROUTE = "00"
DRIVE = {"scenery": "lanes", "sensor": "vlp16", "azimuth_steps": 450, "seed": 0}
"""Options of the simulation. With 16 beams between hedges, odometry drifts by metres within a minute."""


@dataclasses.dataclass(frozen=True)
class DemoCommand:
    """Simulate a drive. From its scans alone, compute odometry, find loops, correct the trajectory and write a map.

    After the simulation, the command does what bin/loops does. The result is compared with the true trajectory.
    """

    out: Path = Path("runs/demo")
    """Output folder. The drive of an earlier demo is not simulated again."""
    scans: int = 300
    """Scans of the drive, 4 a second."""
    open: bool = True
    """Open the page in a browser, if there is one."""


def demo(command: DemoCommand) -> int:
    """Run the command. Returns the exit status."""
    from sglpr_jax.cli.datasets import simulate  # slow import, not needed for --help

    drive, out = command.out / "drive", command.out / "found"
    files = ["--cloud", out / "map.ply", "--grid", out / "map.yaml"]
    if importlib.util.find_spec("rerun"):  # of the extra `view`
        files += ["--rerun", out / "drive.rrd"]
    arguments = [str(word) for word in (drive, "--odometry", AUTO, "--optimize", "--out", out, *files)]
    loops = dataclasses.replace(parse_command(LoopsCommand, "loops", arguments), open=command.open)
    check_flags(loops)  # an error before the simulation if a package is missing
    simulate(drive, routes=(ROUTE,), scans=command.scans, **DRIVE)
    _print_title(shlex.join(["bin/loops", *arguments]))
    status = loops_of_recording(loops)
    if not status:
        _print_title(
            "With your own scans: bin/loops my_scans --odometry auto --optimize --cloud map.ply --grid map.yaml"
        )
    return status


def _print_title(text: str) -> None:
    print(with_installed_names(f"\n{text}"), file=sys.stderr)
