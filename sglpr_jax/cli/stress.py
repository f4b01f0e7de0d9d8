"""bin/stress: how much every method loses when the scans are disturbed, under the same protocols."""

import dataclasses
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from sglpr_jax.cli.descriptor_files import embed_or_reuse, fingerprint
from sglpr_jax.cli.methods import Method, MethodName, method_named
from sglpr_jax.cli.runtime import console, run, write_json
from sglpr_jax.data import Drive, ImageSequence, open_sequence
from sglpr_jax.data.disturbances import CLEAN, ROTATION, Disturbance, chosen_disturbances
from sglpr_jax.data.disturbed import disturbed
from sglpr_jax.data.kitti import PoseChoice
from sglpr_jax.data.scan_files import ScanFormat
from sglpr_jax.evaluation import figures
from sglpr_jax.evaluation.inputs.choice import ALL, check_names
from sglpr_jax.evaluation.page import can_draw
from sglpr_jax.evaluation.protocols import PROTOCOLS, Result, protocol_named
from sglpr_jax.evaluation.report import evaluate
from sglpr_jax.evaluation.stress import StressRow, changes_by_kind, stress_json, stress_table

DEFAULT_PROTOCOLS = ("top1-f1max", "pairs-f1max")


@dataclasses.dataclass(frozen=True)
class StressCommand:
    """Score methods on a sequence as it is, and with every scan turned, occluded, thinned, noisy or moved.

    An interrupted run goes on where it stopped: descriptors that are there are taken again, if made alike.

    Examples:
      bin/stress --weights runs/small-08 --data KITTI --seq 08 --out stress-08
      bin/stress --method scan-context solid --data KITTI --seq 08 --out stress-08 --only rotation beams-16
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
    """References that need no weights, as in bin/embed."""
    protocols: tuple[str, ...] = ()
    """Their names, or `all`. None named: top1-f1max and pairs-f1max."""
    only: tuple[str, ...] = ()
    """Names (beams-16) or kinds (beams) of disturbances. None named: all; of ready-made images rotation alone."""
    poses: PoseChoice = "auto"
    """Which poses of KITTI's layout: SemanticKITTI's (sequences/NN/poses.txt) or KITTI's own (poses/NN.txt)."""
    format: ScanFormat = "auto"
    """What the scans of a plain folder are, where their names do not tell."""
    seed: int = 0
    """A scan's disturbance is a function of it and the scan's number."""
    batch: int = 16
    """Images described at a time."""


def stress_test(command: StressCommand) -> Path:
    """Do what the command says; returns the folder written."""
    protocols = _chosen_protocols(command.protocols)
    chosen_disturbances(command.only)
    sequence = open_sequence(command.data, command.seq, poses=command.poses, format=command.format)
    disturbances = _fitting(sequence, command.only, command.seed)
    methods = _methods(command, sequence)
    (command.out / "descriptors").mkdir(parents=True, exist_ok=True)
    rows = [
        _row(command, sequence, disturbance, methods, protocols, progress=f"{i + 1}/{len(disturbances) + 1}")
        for i, disturbance in enumerate((CLEAN, *disturbances))
    ]
    write_json(command.out / "config.json", _config(command, sequence, protocols, disturbances, methods))
    _write(command.out, rows, title=f"sequence {sequence.name}, {len(sequence)} scans")
    return command.out


def _row(
    command: StressCommand,
    sequence: Drive,
    disturbance: Disturbance,
    methods: Mapping[str, Method],
    protocols: Sequence[str],
    *,
    progress: str,
) -> StressRow:
    """Embed and score every method under one disturbance; ValueError where the clean sequence has no revisit at all."""
    results: dict[str, list[Result]] = {}
    for name, method in methods.items():
        file = embed_or_reuse(
            command.out / "descriptors" / f"{disturbance.name}-{name}.npz",
            method,
            sequence,
            disturbance,
            seed=command.seed,
            batch=command.batch,
            title=f"{progress} {disturbance.name} {name}",
        )
        results[name] = evaluate(file, protocols)
        if np.isnan([result.score for result in results[name]]).all():
            raise ValueError(
                f"sequence {sequence.name}: expected a place that is visited twice, found none under "
                f"{', '.join(protocols)}, so there is nothing to lose"
            )
    return StressRow(disturbance.name, disturbance.kind, disturbance.label, results)


def _chosen_protocols(names: Sequence[str]) -> list[str]:
    check_names(names)
    chosen = list(PROTOCOLS) if ALL in names else list(dict.fromkeys(names or DEFAULT_PROTOCOLS))
    for name in chosen:
        protocol_named(name)  # those of listed pairs take no descriptors
    return chosen


def _fitting(sequence: Drive, names: Sequence[str], seed: int) -> tuple[Disturbance, ...]:
    """The disturbances asked for, each tried on the first scan; ValueError where one does not fit the sequence."""
    if sequence.positions is None:
        raise ValueError(f"sequence {sequence.name}: expected poses to score against, found none")
    if isinstance(sequence, ImageSequence) and not names:
        print(f"sequence {sequence.name} has only images, which can only be turned", file=sys.stderr)
        return (ROTATION,)
    chosen = chosen_disturbances(names)
    for disturbance in chosen:
        if disturbance != ROTATION:
            disturbed(sequence, disturbance, seed=seed).points(0)
    return chosen


def _methods(command: StressCommand, sequence: Drive) -> dict[str, Method]:
    names: list[MethodName] = ["sglpr"] if command.weights is not None else []
    names = list(dict.fromkeys([*names, *command.method]))
    if not names:
        raise ValueError("expected --weights (a name, or a training run's folder) or --method, found neither")
    return {name: method_named(name, command.weights, sequence) for name in names}


def _config(
    command: StressCommand,
    sequence: Drive,
    protocols: Sequence[str],
    disturbances: Sequence[Disturbance],
    methods: Mapping[str, Method],
) -> dict[str, Any]:
    return {
        "data": str(command.data),
        "sequence": sequence.name,
        "scans": fingerprint(sequence),
        "poses": sequence.pose_source,
        "seed": command.seed,
        "protocols": list(protocols),
        "disturbances": [dataclasses.asdict(disturbance) for disturbance in disturbances],
        "methods": {name: {**method.about, "weights": method.weights_hash} for name, method in methods.items()},
    }


def _write(folder: Path, rows: Sequence[StressRow], *, title: str) -> None:
    """Print the table; write numbers and plot; without matplotlib, say what is left out."""
    console().print(stress_table(rows, title=title))
    write_json(folder / "results.json", stress_json(rows))
    print(f"written: {folder / 'results.json'}")
    if can_draw():
        figures.save(figures.stress(changes_by_kind(rows), title=title), folder / "stress.png")
        print(f"written: {folder / 'stress.png'}")
    else:
        print("no drawing: it needs the extra `viz` (pip install 'sglpr-jax[viz]')", file=sys.stderr)


def main() -> None:
    """The entry point."""
    run(lambda: stress_test(tyro.cli(StressCommand, prog="stress")))


if __name__ == "__main__":
    main()
