"""bin/stress: how much every method loses when the scans are corrupted, by the same protocols."""

import dataclasses
import sys
from pathlib import Path

from sglpr_jax.cli.datasets import open_recording
from sglpr_jax.cli.runtime import console, parse_command, progress_bar, run
from sglpr_jax.data.choices import PoseChoice, PoseFormat, ScanFormat, SensorHeight
from sglpr_jax.data.corruption.corruptions import chosen_corruptions
from sglpr_jax.evaluation import figures
from sglpr_jax.evaluation.stress_test import stress_protocols, stress_test, write_stress_test
from sglpr_jax.methods.names import MethodName
from sglpr_jax.methods.registry import methods_named


@dataclasses.dataclass(frozen=True)
class StressCommand:
    """Score methods on a recording as it is, and with every scan rotated, occluded, thinned, noisy or moved.

    An interrupted run goes on where it stopped: descriptors that are there are used again, if made alike.

    Examples:
      bin/stress --weights runs/small-08 --data KITTI --seq 08 --out stress-08
      bin/stress --method scan-context solid --data KITTI --seq 08 --out stress-08 --corruption rotation beams-16
    """

    data: Path
    """A dataset (KITTI's layout, ready-made BEV images) or a folder of scans with poses."""
    out: Path
    """Folder for results.json, config.json, stress.png and the descriptors; made if need be."""
    seq: str | None = None
    """Which sequence; may be left out where there is only one."""
    weights: str | None = None
    """The name of shipped weights or a training run's folder: the network is among the methods."""
    method: tuple[MethodName, ...] = ()
    """Methods that need no weights."""
    protocol: tuple[str, ...] = ()
    """Their names, or `all`. None named: top1-f1max and pairs-f1max."""
    corruption: tuple[str, ...] = ()
    """Names (beams-16) or kinds (beams) of corruptions. None named: all; of ready-made images rotation alone."""
    pose_source: PoseChoice = "auto"
    """Which poses of KITTI's layout: SemanticKITTI's (sequences/NN/poses.txt) or KITTI's own (poses/NN.txt)."""
    format: ScanFormat = "auto"
    """What each point of a .bin is, where neither its name nor a look into the files tells."""
    sensor_height: SensorHeight = "auto"
    """How many metres the sensor is above the ground; `estimate` finds it, and the tilt, from the scans, and `auto`
    does where the layout (a plain folder, a bag) does not tell."""
    poses: Path | None = None
    """The pose file of a plain folder, a row for each scan, where none lies beside the scans."""
    pose_format: PoseFormat = "auto"
    """kitti: camera frame (KITTI, SemanticKITTI); lidar: 12 numbers, z up; tum; csv with a header (x, y, z, t)."""
    times: Path | None = None
    """Seconds, one number a line, where no times.txt lies beside the scans."""
    seed: int = 0
    """A scan's corruption is a function of it and the scan's number."""
    batch: int = 16
    """Images described at a time."""


def run_stress_test(command: StressCommand) -> Path:
    """Do what the command says; returns the folder written."""
    stress_protocols(command.protocol)  # what is wrong with these is said first
    chosen_corruptions(command.corruption)
    recording = open_recording(
        command.data,
        command.seq,
        pose_source=command.pose_source,
        format=command.format,
        poses=command.poses,
        pose_format=command.pose_format,
        times=command.times,
        sensor_height=command.sensor_height,
    )
    if recording.has_images and not command.corruption:
        print(f"sequence {recording.name} has only images, which can only be rotated", file=sys.stderr)
    found = stress_test(
        recording,
        methods_named(command.method, command.weights, recording),
        folder=command.out,
        corruptions=command.corruption,
        protocols=command.protocol,
        seed=command.seed,
        batch=command.batch,
        progress=progress_bar,
    )
    for name, reason in found.left_out.items():
        print(f"{name} left out: {reason}", file=sys.stderr)
    console().print(found)
    for path in write_stress_test(found, command.out):
        print(f"written: {path}")
    if not figures.can_draw():
        print("no drawing: it needs the extra `viz` (pip install 'sglpr-jax[viz]')", file=sys.stderr)
    return command.out


def main() -> None:
    """The entry point."""
    run(lambda: parse_command(StressCommand, "stress"), run_stress_test)


if __name__ == "__main__":
    main()
