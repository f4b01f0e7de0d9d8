"""The test after a training: the drive never seen, raw and with every scan turned, beside methods without training."""

import importlib.util
from pathlib import Path

import jax

from sglpr_jax.cli.methods import Method, network, reference
from sglpr_jax.cli.runtime import console, progress_bar, write_json
from sglpr_jax.cli.segment import score_semantics
from sglpr_jax.data import Drive
from sglpr_jax.evaluation import figures
from sglpr_jax.evaluation.protocols import Result
from sglpr_jax.evaluation.report import comparison, evaluate, table, to_json
from sglpr_jax.models.sglpr import Params, init

ROTATION_SEED = 0
TRAINED = "sglpr"


def final_test(params: Params, sequence: Drive, folder: Path, *, seed: int, references: bool = True) -> None:
    """Embed, score, print and draw; everything that is printed is also written into `folder`.

    Without `references` the trained network stands alone.
    """
    folder.mkdir(parents=True, exist_ok=True)
    methods: dict[str, Method] = {TRAINED: network(params)}
    if references:
        methods["untrained"] = network(init(jax.random.key(seed + 1), config=params.config))
        methods |= {name: reference(name, sequence, params.config.grid) for name in ("thumbnail", "polar-fft")}
    report: dict = {"sequence": sequence.name}
    for title, rotation_seed in (("raw", None), ("rotated", ROTATION_SEED)):
        results = _score(methods, sequence, folder, title, rotation_seed)
        report[title] = {name: to_json(scored) for name, scored in results.items()}
        _print(results, f"sequence {sequence.name}, {title}")
        if importlib.util.find_spec("matplotlib"):
            _draw(results, sequence, folder, title)
    if params.config.segments and sequence.has_labels:
        report["segmentation"] = score_semantics(params, sequence, folder)
    write_json(folder / "results.json", report)
    console().print(f"written to {folder}")


def _score(
    methods: dict[str, Method],
    sequence: Drive,
    folder: Path,
    title: str,
    rotation_seed: int | None,
) -> dict[str, list[Result]]:
    results = {}
    for name, method in methods.items():
        with progress_bar(f"embed {title} {name}", len(sequence)) as show:
            file = method.embed(sequence, rotation_seed=rotation_seed, on_progress=show)
        file.save(folder / f"{name}-{title}.npz")
        results[name] = evaluate(file)
    return results


def _print(results: dict[str, list[Result]], title: str) -> None:
    console().print(table(results[TRAINED], title=f"{title}: {TRAINED}"))
    console().print(comparison(results, title=title))


def _draw(results: dict[str, list[Result]], sequence: Drive, folder: Path, title: str) -> None:
    top1 = {name: scored[0] for name, scored in results.items()}
    curves = {name: result.curve for name, result in top1.items() if result.curve is not None}
    if curves:  # none where the drive has no revisit
        picture = figures.precision_recall(curves, title=f"{sequence.name}, {title}: top-1")
        figures.save(picture, folder / f"precision-recall-{title}.png")
    decisions = top1[TRAINED].decisions
    if decisions is not None and sequence.positions is not None:
        figures.save(figures.trajectory(sequence.positions, decisions), folder / f"trajectory-{title}.png")
