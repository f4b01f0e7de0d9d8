"""bin/evaluate: score what any method says of a sequence, or of several sessions, under chosen protocols."""

import dataclasses
import sys
from pathlib import Path
from typing import Any

import tyro

from sglpr_jax.cli.evaluate_inputs import PoseOptions, open_dataset, read_methods, score
from sglpr_jax.cli.evaluate_sessions import evaluate_session_files
from sglpr_jax.cli.page_pictures import take_pictures
from sglpr_jax.cli.runtime import console, run, write_json, write_text
from sglpr_jax.data.trajectory import PoseFormat
from sglpr_jax.evaluation import figures
from sglpr_jax.evaluation.inputs import Input
from sglpr_jax.evaluation.inputs.choice import check_names
from sglpr_jax.evaluation.page import Evaluation, Pictures, can_draw, draw_curves, draw_trajectory, page
from sglpr_jax.evaluation.protocols import ScoredPairs, TopK
from sglpr_jax.evaluation.report import (
    PUBLISHED_NOTE,
    comparison,
    published_rows,
    published_table,
    table,
    to_json,
)
from sglpr_jax.retrieval.descriptor_file import DescriptorFile

PAGE = "report.html"


@dataclasses.dataclass(frozen=True)
class EvaluateCommand:
    """Print what a method scores under each protocol; write the table, its pictures and a page with all of them.

    FILE is a descriptor file that bin/embed wrote, a .npy of descriptors (a row per frame), or text: a top-k list with
    lines `query: frame frame ...` or `query: frame=score ...`, or scored pairs with lines `i j score [label]`. Frames
    are numbered from 0, and a higher score is closer.

    Examples:
      bin/evaluate 08.npz
      bin/evaluate mine.npy --poses poses/08.txt --pose-format kitti --times times.txt --distance cosine
      bin/evaluate mine.npy --data KITTI --seq 08 --protocols all --compare 08.npz
      bin/evaluate 2012-02-04.npz 2012-03-17.npz --database 2012-01-15.npz --published
    """

    file: tyro.conf.Positional[Path]
    """Descriptors, a top-k list or scored pairs."""
    more: tyro.conf.Positional[tuple[Path, ...]] = ()
    """With --database: descriptor files of further sessions; the table then has a column for each."""
    database: Path | None = None
    """The descriptor file of the session that is the map: the others ask it, by the protocols across sessions
    (bevplace-nclt-recall, pointnetvlad-recall)."""
    published: bool = False
    """Print the paper's numbers as well, marked as published: those of table 1 for the sequence, or of table 3."""
    out: Path | None = None
    """Folder for results.json, report.html and the pictures. None: FILE without its ending."""
    poses: Path | None = None
    """Where the frames were taken, a row each. None: as the descriptor file says, or the sequence of --data."""
    pose_format: PoseFormat = "auto"
    """kitti: camera frame (KITTI, SemanticKITTI); lidar: 12 numbers, z up; tum; csv with a header (x, y, z, t)."""
    times: Path | None = None
    """Seconds, one number a line, beside --poses."""
    distance: str | None = None
    """How the descriptors of a .npy are compared: l2 (None), cosine, ... A descriptor file says it itself."""
    protocols: tuple[str, ...] = ()
    """Their names, or `all`. None named: top1-f1max, pairs-f1max and bevplace-recall-at-1."""
    compare: tuple[Path, ...] = ()
    """Files of other methods on the same frames, to stand beside FILE."""
    data: Path | None = None
    """A dataset with the frames as scans or images: the page then shows them."""
    seq: str | None = None
    """The sequence: which of --data, and in which FILE has no name of its own, whose published split counts."""
    weights: str | None = None
    """The name of shipped weights or a training run's folder: with --data the page then shows semantic maps and feature
    heat maps."""


def evaluate_file(command: EvaluateCommand) -> Path:
    """Do what the command says; returns the folder written."""
    if command.database is not None:
        return _evaluate_sessions(command, command.database)
    if command.more:
        raise ValueError(
            f"expected --database beside several files, found {command.more[0]} without; methods to stand "
            "beside FILE are given by --compare"
        )
    check_names(command.protocols)
    sequence, params = open_dataset(command.data, command.seq, command.weights)
    poses = PoseOptions(command.poses, command.pose_format, command.times)
    paths = (command.file, *command.compare)
    inputs = read_methods(paths, poses, sequence=sequence, seq=command.seq, distance=command.distance)
    source = next(iter(inputs.values()))
    found = Evaluation(
        title=_title(source, command.file),
        about=_about(source, command.file),
        methods=score(inputs, command.protocols),
        positions=source.positions,
        published=published_rows(_sequence_of(source)) if command.published else (),
    )
    console().print(table(found.results, title=found.title))
    if len(found.methods) > 1:
        console().print(comparison(found.methods))
    if found.published:
        console().print(published_table(found.published))
        console().print(PUBLISHED_NOTE, soft_wrap=True)
    pictures = Pictures() if sequence is None else take_pictures(sequence, params, source, found.worst)
    folder = command.out or _folder(command.file)
    _write(folder, found, pictures, _as_json(found, source, command.file))
    return folder


def _evaluate_sessions(command: EvaluateCommand, database: Path) -> Path:
    """Ask one session about the others; ValueError for options that say nothing there."""
    silent = ("poses", "times", "distance", "compare", "data", "seq", "weights")
    given = [name for name in silent if getattr(command, name)]
    if given:
        raise ValueError(f"expected descriptor files alone beside --database, found --{given[0]}")
    return evaluate_session_files(
        (command.file, *command.more),
        database,
        protocols=command.protocols,
        published=command.published,
        folder=command.out or _folder(command.file),
        page=PAGE,
    )


def _write(folder: Path, found: Evaluation, pictures: Pictures, numbers: dict[str, Any]) -> None:
    """Write numbers, plots and the page; without matplotlib, say what is left out."""
    curves, trajectory = {}, {}
    if can_draw():
        curves, trajectory = draw_curves(found), draw_trajectory(found)
    else:
        print("no drawings: they need the extra `viz` (pip install 'sglpr-jax[viz]')", file=sys.stderr)
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / "results.json", numbers)
    plots = curves | trajectory
    for name, figure in plots.items():
        figures.save(figure, folder / name)
    write_text(folder / PAGE, page(found, curves=curves, trajectory=trajectory, pictures=pictures))
    for name in ("results.json", *plots, PAGE):
        print(f"written: {folder / name}")


def _folder(file: Path) -> Path:
    """Return the file without its ending; a file that has none keeps its name and the folder gets another."""
    return file.with_suffix("") if file.suffix else file.with_name(f"{file.name}-results")


def _title(source: Input, file: Path) -> str:
    if isinstance(source, ScoredPairs):
        return f"{file.name}, {len(source.pairs)} pairs"
    return f"sequence {source.sequence}, {len(source)} scans"


def _sequence_of(source: Input) -> str:
    return "scored pairs" if isinstance(source, ScoredPairs) else source.sequence


def _about(source: Input, file: Path) -> str:
    """Say what the file holds and how it is compared."""
    if isinstance(source, ScoredPairs):
        return f"{file}: scored pairs" + (" with labels" if source.labels is not None else "")
    if isinstance(source, TopK):
        return f"{file}: up to {source.nearest.shape[1]} retrieved frames for each of {len(source.queries)} queries"
    return f"{file}: descriptors of {source.descriptors.shape[1]} numbers, compared by {source.distance}"


def _as_json(found: Evaluation, source: Input, file: Path) -> dict[str, Any]:
    about: dict[str, Any] = {"file": str(file)}
    if isinstance(source, DescriptorFile):
        about |= {"config": source.config, "weights_hash": source.weights_hash, "distance": source.distance}
    others = {name: to_json(results) for name, results in list(found.methods.items())[1:]}
    worst = [dataclasses.asdict(mistake) for mistake in found.worst]
    return {
        **about,
        "results": to_json(found.results),
        "false_positives": worst,
        "compared": others,
        "published": found.published,
    }


def main() -> None:
    """The entry point."""
    run(lambda: evaluate_file(tyro.cli(EvaluateCommand, prog="evaluate")))


if __name__ == "__main__":
    main()
