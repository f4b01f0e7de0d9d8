"""bin/evaluate: score the results of any method on a recording or on several sessions."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from sglpr_jax.cli.config_file import record_command
from sglpr_jax.cli.recording import RecordingOptions
from sglpr_jax.cli.runtime import console, open_page
from sglpr_jax.data.choices import PoseFormat

if TYPE_CHECKING:
    from sglpr_jax.evaluation.evaluation_page import Pictures
    from sglpr_jax.evaluation.scoring import Evaluation


@dataclasses.dataclass(frozen=True)
class EvaluateCommand:
    """Print the scores of a method by each protocol. Write the table, its pictures and a page with all of them.

    FILE is a descriptor file of bin/embed, a .npy file of descriptors (one row per frame), or text. Text is a top-k
    list with lines `query: frame frame ...` or `query: frame=score ...`, or scored pairs with lines `i j score
    [label]`. Frames are numbered from 0, and a higher score means more similar.

    Example:
      bin/evaluate 08.npz
      bin/evaluate 08.npz --published                     beside the paper's numbers
      bin/evaluate mine.npy --poses poses/08.txt --pose-format kitti --times times.txt --distance cosine
      bin/evaluate mine.npy --data KITTI --seq 08 --protocol all --compare 08.npz
      bin/evaluate 2012-02-04.npz 2012-03-17.npz --database 2012-01-15.npz --published
    """

    file: tyro.conf.Positional[Path]
    """Descriptors, a top-k list or scored pairs."""
    more: tyro.conf.Positional[tuple[Path, ...]] = ()
    """With --database: descriptor files of further sessions. The table has a column for each."""
    database: Path | None = None
    """Descriptor file of the database session. The frames of FILE are searched in it, by the protocols across sessions
    (bevplace-nclt-recall, pointnetvlad-recall)."""
    published: bool = False
    """Also print the paper's numbers, marked as published: table 1 for the sequence, or table 3 with --database."""
    out: Path | None = None
    """Folder for results.json, report.html, command.json and the pictures. None: FILE without its suffix, plus
    -results if this name is taken, for example by the folder of the scans."""
    poses: Path | None = None
    """Pose file with one row per frame. If FILE has times, poses at other times are interpolated. If --skip-bad skipped
    scans of FILE, a row for every scan is accepted, too. None: the poses in FILE, or those of --data."""
    pose_format: PoseFormat = "auto"
    """kitti: camera frame (KITTI, SemanticKITTI); lidar: 12 numbers, z up; tum; csv with a header (x, y, z, t)."""
    times: Path | None = None
    """File of timestamps for --poses: one number a line, in `--time-unit`."""
    distance: str | None = None
    """Distance between descriptors of a .npy file: l2 (None), cosine, ... Descriptor files define it themselves."""
    protocol: tuple[str, ...] = ()
    """Names of protocols (docs/concepts/protocols.md), or `all`. If omitted, top1-f1max (most likely SG-LPR's own,
    which its paper does not state), pairs-f1max and bevplace-recall-at-1."""
    compare: tuple[Path, ...] = ()
    """Files of other methods on the same frames, to compare with FILE. Without poses or times of their own, they use
    those of FILE. If FILE has no times, it uses those of the first file that has them."""
    data: Path | None = None
    """Dataset with the scans or images of the frames, which the page then shows. --seq selects the sequence. If FILE
    does not name its sequence, --seq names it. Published splits depend on this name."""
    source: tyro.conf.OmitArgPrefixes[RecordingOptions] = RecordingOptions()
    weights: str | None = None
    """Name of shipped weights or folder of a training run. With --data, the page then shows semantic maps and feature
    heat maps."""
    open: bool = False
    """Open the page in a browser."""


def evaluate_file(command: EvaluateCommand) -> None:
    # Slow imports, not needed for --help.
    from sglpr_jax.evaluation.evaluation_page import NUMBERS, PAGE, write_evaluation
    from sglpr_jax.evaluation.sessions import evaluate_sessions
    from sglpr_jax.files import check_writable

    _check_options(command)
    folder, pictures = command.out or _default_folder(command.file), None
    check_writable(folder / NUMBERS)
    if command.database is not None:
        files = (command.file, *command.more)
        evaluation = evaluate_sessions(command.database, files, command.protocol, published=command.published)
        console().print(evaluation)
    else:
        evaluation, pictures = _evaluate_recording(command)
    for path in (*write_evaluation(evaluation, folder, pictures), record_command(command, folder)):
        print(f"written: {path}")
    if command.open:
        open_page(folder / PAGE)


def _evaluate_recording(command: EvaluateCommand) -> "tuple[Evaluation, Pictures | None]":
    """Score FILE and the files of --compare, and print the table. With --data, also return pictures."""
    from sglpr_jax.data.formats.pose_files import read_trajectory
    from sglpr_jax.evaluation.evaluation_page import take_pictures
    from sglpr_jax.evaluation.inputs import read_methods, recording_rows, recording_trajectory
    from sglpr_jax.evaluation.scoring import evaluate_methods
    from sglpr_jax.models.weights_file import load

    params = None if command.weights is None else load(command.weights)
    recording = None if command.data is None else command.source.open(command.data)
    poses = None
    if command.poses is not None:
        unit = command.source.time_unit
        poses = read_trajectory(command.poses, format=command.pose_format, times=command.times, time_unit=unit)
    methods = read_methods(
        (command.file, *command.compare),
        poses=poses,
        dataset=None if recording is None else recording_trajectory(recording),
        sequence=command.source.seq or (None if recording is None else recording.name),
        distance=command.distance,
    )
    first_method = next(iter(methods.values()))
    if recording is not None:
        recording_rows(recording, first_method)  # raises an error before scoring if the frames differ
    evaluation = evaluate_methods(methods, command.protocol, published=command.published, file=command.file)
    console().print(evaluation)
    if recording is None:
        return evaluation, None
    return evaluation, take_pictures(recording, params, first_method, evaluation.worst_false_positives)


def _check_options(command: EvaluateCommand) -> None:
    """Raise ValueError if options exclude each other."""
    from sglpr_jax.evaluation.protocols import check_names

    if command.database is not None:
        unused = ("poses", "times", "distance", "compare", "data", "weights")
        stated = [name for name in unused if getattr(command, name)]
        if command.source.seq:
            stated.append("seq")
        if stated:
            raise ValueError(f"expected only descriptor files with --database, found --{stated[0]}")
        return
    if command.more:
        raise ValueError(
            f"expected --database with several files, found {command.more[0]} without it; "
            "to compare methods, use --compare"
        )
    if command.weights is not None and command.data is None:
        raise ValueError(f"{command.weights}: expected --data with --weights, found none")
    if command.times is not None and command.poses is None:
        raise ValueError(f"{command.times}: expected --poses with --times, found none")
    check_names(command.protocol)


def _default_folder(file: Path) -> Path:
    """Return the path of a file without its suffix, plus "-results" if that path exists and is no folder of results."""
    from sglpr_jax.evaluation.evaluation_page import PAGE

    folder = file.with_suffix("")
    is_free = not folder.exists() or (folder / PAGE).is_file()
    return folder if is_free else folder.with_name(f"{folder.name}-results")
