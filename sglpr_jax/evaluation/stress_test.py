"""The stress test: every method described and scored on a recording as it is, and on corrupted ones."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sglpr_jax.data import Recording
from sglpr_jax.data.corruption.corrupted import corrupted
from sglpr_jax.data.corruption.corruptions import CLEAN, ROTATION, Corruption, chosen_corruptions
from sglpr_jax.evaluation import figures
from sglpr_jax.evaluation.protocols import Result, protocol_named, protocols_taking
from sglpr_jax.evaluation.protocols.choice import ALL, check_names
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
    """Score every method on the recording as it is and under each corruption.

    `corruptions` are names or kinds of them; none named: all, of ready-made images rotation alone. `protocols` are
    names of those that score descriptors; none named: top-1 F1max and pairs F1max. Descriptors are kept in `folder` and
    used again where they were made alike. `progress` shows how far each embedding is. A corruption that needs the rings
    of the lasers is left out of a recording that does not tell them; the result says so. Raises ValueError where the
    recording has no poses or no revisit, another corruption or a method does not fit it, or no corruption is left.
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
    """Return the protocols asked for; `all` stands for every one that scores descriptors. ValueError for others."""
    check_names(names)
    known = protocols_taking("descriptors")
    chosen = list(known) if ALL in names else list(dict.fromkeys(names or DEFAULT_PROTOCOLS))
    for name in chosen:
        protocol_named(name, known)
    return chosen


def fitting_corruptions(
    recording: Recording, names: Sequence[str], seed: int
) -> tuple[tuple[Corruption, ...], dict[str, str]]:
    """Return the corruptions asked for, each tried on three scans; of ready-made images rotation where none is.

    Beside them, why which others were left out: those that need rings, where the scans have none. Raises ValueError
    where the recording has no poses, another one does not fit it, or none is left.
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
    """Corrupt the first, the middle and the last scan. Raises what that raises."""
    if corruption != ROTATION:
        scans = corrupted(recording, corruption, seed=seed)
        for row in sorted({0, len(recording) // 2, len(recording) - 1}):
            scans.points(row)


def write_stress_test(found: StressTest, folder: Path) -> list[Path]:
    """Write configuration, numbers and, with matplotlib, the plot. Returns the paths of numbers and plot."""
    write_json(folder / "config.json", found.config)
    write_json(folder / "results.json", found.to_json())
    if not figures.can_draw():
        return [folder / "results.json"]
    figures.save(figures.stress(changes_by_kind(found.rows), title=found.title), folder / "stress.png")
    return [folder / "results.json", folder / "stress.png"]


def _check_revisits(recording: Recording, results: Sequence[Result], protocols: Sequence[str]) -> None:
    """Raise ValueError where no protocol has a score: without a revisit there is nothing to lose."""
    if np.isnan([result.score for result in results]).all():
        raise ValueError(
            f"sequence {recording.name}: expected a place that is visited twice, found none under "
            f"{', '.join(protocols)}, so there is nothing to lose"
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
