"""bin/stress: measure how much each method loses when the scans are corrupted."""

import dataclasses
import sys
from pathlib import Path

import tyro

from sglpr_jax.cli.config_file import record_command
from sglpr_jax.cli.recording import PosedRecordingOptions
from sglpr_jax.cli.runtime import console, parse_command, progress_bar, run
from sglpr_jax.fields import CountOrNone, Size
from sglpr_jax.methods.names import MethodName


@dataclasses.dataclass(frozen=True)
class StressCommand:
    """Score methods on the clean recording, and with every scan rotated, occluded, thinned, noisy or moved.

    The same command continues an interrupted run. Existing descriptor files with the same inputs are reused.

    Example:
      bin/stress --weights runs/sglpr-08 --data KITTI --seq 08 --out stress-08
      bin/stress --method scan-context solid --data KITTI --seq 08 --out stress-08 --corruption rotation beams-16
    """

    data: Path
    """A dataset, in KITTI's layout or as ready-made BEV images, or a folder of scans with poses."""
    out: Path
    """Folder for results.json, config.json, command.json, stress.png and the descriptors. It is created if it does not
    exist."""
    weights: str | None = None
    """Name of shipped weights or folder of a training run. The network with these weights is added to the methods.
    None: sglpr if --method is not given, otherwise no network."""
    method: tuple[MethodName, ...] = ()
    """Methods that need no weights."""
    protocol: tuple[str, ...] = ()
    """Names of protocols, or `all`. If omitted, top1-f1max and pairs-f1max."""
    corruption: tuple[str, ...] = ()
    """Names (beams-16) or kinds (beams) of corruptions. If omitted, all corruptions, or only rotation for ready-made
    images."""
    source: tyro.conf.OmitArgPrefixes[PosedRecordingOptions] = PosedRecordingOptions()
    seed: CountOrNone = 0
    """Seed of the corruptions. The seed and the scan's number determine the corruption of a scan."""
    batch: Size = 8
    """Maximum number of images that are described at a time."""


def run_stress_test(command: StressCommand) -> Path:
    """Run the command. Returns the output folder."""
    from sglpr_jax.data.corruption import (
        chosen_corruptions,  # slow imports, not needed for --help
    )
    from sglpr_jax.evaluation import figures
    from sglpr_jax.evaluation.stress_test import stress_protocols, stress_test, write_stress_test
    from sglpr_jax.files import check_writable
    from sglpr_jax.methods.registry import methods_named
    from sglpr_jax.models.weights_file import load

    stress_protocols(command.protocol)  # report invalid names before the recording is opened
    chosen_corruptions(command.corruption)
    check_writable(command.out / "results.json")
    params = None if command.weights is None else load(command.weights)
    recording = command.source.open(command.data)
    if recording.has_images and not command.corruption:
        print(f"sequence {recording.name} has only images, which can only be rotated", file=sys.stderr)
    found = stress_test(
        recording,
        methods_named(command.method, params, recording),
        folder=command.out,
        corruptions=command.corruption,
        protocols=command.protocol,
        seed=command.seed,
        batch=command.batch,
        progress=progress_bar,
    )
    for name, reason in found.left_out.items():
        print(f"skipped {name}: {reason}", file=sys.stderr)
    console().print(found)
    for path in (*write_stress_test(found, command.out), record_command(command, command.out)):
        print(f"written: {path}")
    if not figures.can_draw():
        print("no drawing: it needs the extra `viz` (pip install 'sglpr-jax[viz]')", file=sys.stderr)
    return command.out


def main() -> None:
    """The entry point."""
    run(lambda: parse_command(StressCommand, "stress"), run_stress_test)


if __name__ == "__main__":
    main()
