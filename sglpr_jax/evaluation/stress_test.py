"""Stress test: scores of several methods on a recording, clean and corrupted."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sglpr_jax.data.corruption import CLEAN, ROTATION, Corruption, chosen_corruptions, corrupted
from sglpr_jax.data.recording import Recording
from sglpr_jax.evaluation import figures
from sglpr_jax.evaluation.protocols import ALL, check_names, protocol_named, protocols_taking
from sglpr_jax.evaluation.protocols.protocol import Result
from sglpr_jax.evaluation.scoring import score
from sglpr_jax.evaluation.stress_table import StressRow, StressTest, changes_by_kind
from sglpr_jax.files import write_json
from sglpr_jax.methods.method import Method
from sglpr_jax.progress import Progress, no_progress
from sglpr_jax.retrieval.reuse import embed_or_reuse, fingerprint

DEFAULT_PROTOCOLS = ("top1-f1max", "pairs-f1max")


def stress_test(
    recording: Recording,
    methods: Mapping[str, Method],
    *,
    folder: Path,
    corruptions: Sequence[str] = (),
    protocols: Sequence[str] = (),
    seed: int = 0,
    batch: int = 8,
    progress: Progress = no_progress,
) -> StressTest:
    """Score every method on the clean recording and under each corruption.

    A corruption that needs the laser rings is skipped if the recording has no rings (`StressTest.left_out`).

    Arguments:
      recording: Recording with poses and at least one revisit.
      methods: Methods by name.
      folder: Folder for descriptors. Descriptors with the same settings are reused.
      corruptions: Names or kinds of corruptions. By default all; for ready-made images only rotation.
      protocols: Names of protocols that score descriptors. By default, top-1 F1max and pairs F1max are used.
      seed: Seed of the corruptions.
      batch: Number of scans described at a time.
      progress: Reports the progress of each embedding.

    Raises:
      ValueError: If the recording has no poses or no revisit, if a method or another corruption does not fit the
        recording, or if all corruptions were skipped.
    """
    chosen = stress_protocols(protocols)
    fitting, left_out = fitting_corruptions(recording, corruptions, seed)
    (folder / "descriptors").mkdir(parents=True, exist_ok=True)
    rows = []
    for i, corruption in enumerate((CLEAN, *fitting)):
        results = {}
        for name, method in methods.items():
            file = embed_or_reuse(
                folder / "descriptors" / f"{corruption.name}-{name}.npz",
                method,
                recording,
                corruption,
                seed=seed,
                batch=batch,
                title=f"{i + 1}/{len(fitting) + 1} {corruption.name} {name}",
                progress=progress,
            )
            results[name] = score(file, chosen)
            _check_revisits(recording, results[name], chosen)
        rows.append(StressRow(corruption.name, corruption.kind, corruption.label, results))
    title = f"sequence {recording.name}, {len(recording)} scans"
    config = {**_config(recording, methods, fitting, chosen, seed), "left_out": left_out}
    return StressTest(title, rows, config, left_out)


def stress_protocols(names: Sequence[str]) -> list[str]:
    """Return the named protocols, or `DEFAULT_PROTOCOLS`. `all` selects every protocol that scores descriptors.

    Raises ValueError for other protocols.
    """
    check_names(names)
    known = protocols_taking("descriptors")
    chosen = list(known) if ALL in names else list(dict.fromkeys(names or DEFAULT_PROTOCOLS))
    for name in chosen:
        protocol_named(name, known)
    return chosen


def fitting_corruptions(
    recording: Recording, names: Sequence[str], seed: int
) -> tuple[tuple[Corruption, ...], dict[str, str]]:
    """Return the corruptions that can be applied to the recording, and for each skipped one the reason.

    Each corruption is tried on three scans. Corruptions that need laser rings are skipped if the scans have no rings.

    Arguments:
      recording: Recording with poses.
      names: Names or kinds of corruptions. By default all; for ready-made images only rotation.
      seed: Seed of the corruptions.

    Raises:
      ValueError: If the recording has no poses, if a corruption fails for another reason than missing rings, or if all
        corruptions were skipped.
    """
    if recording.positions is None:
        raise ValueError(f"sequence {recording.name}: expected poses to score against, found none")
    if recording.has_images and not names:
        return (ROTATION,), {}
    fitting, left_out = [], {}
    for corruption in chosen_corruptions(names):
        try:
            _try_on(recording, corruption, seed)
            fitting.append(corruption)
        except ValueError as error:
            if recording.has_images or not corruption.needs_lasers:
                raise
            left_out[corruption.name] = str(error)
    if not fitting:
        raise ValueError(next(iter(left_out.values())))
    return tuple(fitting), left_out


def _try_on(recording: Recording, corruption: Corruption, seed: int) -> None:
    """Corrupt the first, the middle and the last scan. Raises ValueError if the corruption does not fit them."""
    if corruption != ROTATION:
        scans = corrupted(recording, corruption, seed=seed)
        for row in sorted({0, len(recording) // 2, len(recording) - 1}):
            scans.points(row)


def write_stress_test(found: StressTest, folder: Path) -> list[Path]:
    """Write the configuration, the results and, if matplotlib is installed, the plot.

    Returns the paths of the results and the plot.
    """
    write_json(folder / "config.json", found.config)
    write_json(folder / "results.json", found.to_json())
    if not figures.can_draw():
        return [folder / "results.json"]
    figures.save(figures.stress(changes_by_kind(found.rows), title=found.title), folder / "stress.png")
    return [folder / "results.json", folder / "stress.png"]


def _check_revisits(recording: Recording, results: Sequence[Result], protocols: Sequence[str]) -> None:
    """Raise ValueError if no protocol has a score, because the recording has no revisit."""
    if np.isnan([result.score for result in results]).all():
        raise ValueError(
            f"sequence {recording.name}: expected a place that is visited twice, found none for "
            f"protocols {', '.join(protocols)}, so no score can drop"
        )


def _config(
    recording: Recording,
    methods: Mapping[str, Method],
    corruptions: Sequence[Corruption],
    protocols: Sequence[str],
    seed: int,
) -> dict[str, Any]:
    return {
        "sequence": recording.name,
        "scans": fingerprint(recording),
        "poses": recording.pose_source,
        "seed": seed,
        "protocols": list(protocols),
        "corruptions": [dataclasses.asdict(corruption) for corruption in corruptions],
        "methods": {name: {**method.about, "weights": method.weights_hash} for name, method in methods.items()},
    }
