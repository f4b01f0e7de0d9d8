"""bin/evaluate: score a descriptor file under every protocol."""

import dataclasses
import importlib.util
import sys
from pathlib import Path

import tyro

from sglpr_jax.cli.runtime import console, run, write_json
from sglpr_jax.evaluation import figures
from sglpr_jax.evaluation.report import evaluate, table, to_json
from sglpr_jax.retrieval.descriptor_file import DescriptorFile


@dataclasses.dataclass(frozen=True)
class EvaluateCommand:
    """Print what a descriptor file scores under every protocol; write the table and its pictures beside it.

    Example: bin/evaluate 08.npz
    """

    file: tyro.conf.Positional[Path]
    """A descriptor file that bin/embed wrote."""
    out: Path | None = None
    """Folder for results.json and the pictures. None: FILE without its ending."""


def evaluate_file(command: EvaluateCommand) -> Path:
    """Do what the command says; returns the folder written."""
    file = DescriptorFile.load(command.file)
    if file.positions is None:
        raise ValueError(
            f"{command.file}: expected positions to score against, found descriptors of scans without poses"
        )
    results = evaluate(file)
    folder = command.out or command.file.with_suffix("")
    folder.mkdir(parents=True, exist_ok=True)
    console().print(table(results, title=f"sequence {file.sequence}, {len(file)} scans"))
    about = {"file": str(command.file), "config": file.config, "weights_hash": file.weights_hash}
    write_json(folder / "results.json", {**about, "results": to_json(results)})
    for name in ("results.json", *_draw(file, results, folder)):
        print(f"written: {folder / name}")
    return folder


def _draw(file: DescriptorFile, results: list, folder: Path) -> list[str]:
    """Draw what can be drawn; without matplotlib, say so."""
    if not importlib.util.find_spec("matplotlib"):
        print("no pictures: they need the extra `viz` (pip install 'sglpr-jax[viz]')", file=sys.stderr)
        return []
    curves = {result.name: result.curve for result in results if result.curve is not None}
    drawn = {}
    if curves:
        drawn["precision-recall.png"] = figures.precision_recall(curves, title=f"sequence {file.sequence}")
    top1 = results[0]
    if file.positions is not None and top1.decisions is not None:
        drawn["trajectory.png"] = figures.trajectory(file.positions, top1.decisions)
    for name, figure in drawn.items():
        figures.save(figure, folder / name)
    return list(drawn)


def main() -> None:
    """The entry point."""
    run(lambda: evaluate_file(tyro.cli(EvaluateCommand, prog="evaluate")))


if __name__ == "__main__":
    main()
