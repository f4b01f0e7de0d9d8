"""bin/reproduce: the paper's tables and figures, made anew on any dataset, beside the paper's numbers."""

import dataclasses
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import tyro

from sglpr_jax.cli.datasets import cached_sessions, dataset_root
from sglpr_jax.cli.presets import load_preset, preset_asked_for
from sglpr_jax.cli.reproduction import pictures, tables
from sglpr_jax.cli.reproduction.check import check
from sglpr_jax.cli.reproduction.experiments import EXPERIMENTS, FULL
from sglpr_jax.cli.reproduction.plan import make_plan, time_a_step
from sglpr_jax.cli.reproduction.runs import Runs
from sglpr_jax.cli.reproduction.scores import across_sessions_rows, f1max_rows, methods_of, top1
from sglpr_jax.cli.runtime import console, run, write_json, write_text
from sglpr_jax.data import Drive, open_sequence, sequence_names
from sglpr_jax.data.kitti import PoseChoice
from sglpr_jax.evaluation import figures
from sglpr_jax.train.config import TrainConfig

What = Literal[
    "all", "table1", "table2", "table3", "table4", "table5", "table6", "table7",
    "figure5", "figure6", "figure7", "figure8", "figure9", "normalisation",
]  # fmt: skip
PAPER_SEQUENCES = ("00", "02", "05", "06", "07", "08")


@dataclasses.dataclass(frozen=True)
class ReproduceCommand:
    """Make tables and figures of the paper anew: train what is missing, embed, evaluate, print ours beside the paper's.

    Every test drive has models of its own, trained on all the other drives (leave-one-out), one for each variant that
    a table compares. Finished runs are kept in --out and used again; an interrupted one goes on.

    Examples:
      bin/reproduce table4 figure9 --plan                          says what would be trained, and how long it takes
      bin/reproduce all                                            on the simulated drives, preset small
      bin/reproduce table1 table2 --data KITTI --preset paper
    """

    what: tyro.conf.Positional[tuple[What, ...]]
    """Which tables and figures."""
    data: Path | None = None
    """The dataset's folder: KITTI's layout, or ready-made BEV images. None: the simulated drives."""
    nclt: Path | None = None
    """Sessions in NCLT's layout, for table 3 and figure 8; the first is the database. None: simulated ones."""
    preset: str = "small"
    """A file of configs/ by name, or a path to one of your own."""
    seqs: tuple[str, ...] = ()
    """The drives to test on. None named: those of 00, 02, 05, 06, 07 and 08 that the dataset has."""
    out: Path = Path("runs/reproduce")
    """Folder for the runs, tables and pictures."""
    baselines: tuple[str, ...] = ("m2dp", "scan-context", "lidar-iris", "ssc", "solid", "polar-fft")
    """Methods without training in tables 1 to 3 and figure 5; on ready-made images only polar-fft and thumbnail go."""
    poses: PoseChoice = "auto"
    """Which poses of KITTI's layout: SemanticKITTI's (sequences/NN/poses.txt) or KITTI's own (poses/NN.txt)."""
    plan: bool = False
    """Only say what would be trained."""
    config: Annotated[TrainConfig, tyro.conf.arg(name=""), tyro.conf.FlagConversionOff] = dataclasses.field(
        default_factory=TrainConfig
    )


def parse(arguments: list[str] | None = None) -> ReproduceCommand:
    """Defaults, overridden by the preset, overridden by the flags."""
    preset = preset_asked_for(arguments, default=ReproduceCommand.preset)
    default = ReproduceCommand(what=(), preset=preset, config=load_preset(preset))
    return tyro.cli(ReproduceCommand, args=arguments, default=default, prog="reproduce")


def reproduce(command: ReproduceCommand) -> Path:
    """Do what the command says; returns its folder."""
    names = list(EXPERIMENTS) if "all" in command.what else list(dict.fromkeys(command.what))
    runs = Runs(command.out, dataset_root(command.data), command.preset, command.config, command.poses)
    seqs = command.seqs or tuple(seq for seq in PAPER_SEQUENCES if seq in sequence_names(runs.data))
    check(runs, names, seqs, command.baselines)
    plan = make_plan(runs, names, seqs)
    print(plan.text(time_a_step(runs, *plan.missing[0]) if plan.missing else None), file=sys.stderr)
    if command.plan:
        return command.out
    for done, (variant, seq) in enumerate(plan.missing):
        print(f"run {done + 1} of {len(plan.missing)}: {variant}, {seq}", file=sys.stderr)
        runs.train(variant, seq)
    command.out.mkdir(parents=True, exist_ok=True)
    write_json(command.out / "config.json", json.loads(json.dumps(dataclasses.asdict(command), default=str)))
    for name in names:
        make = _make_pictures if name.startswith("figure") else _make_table
        make(name, command, runs, seqs)
    return command.out


def _make_table(name: str, command: ReproduceCommand, runs: Runs, seqs: Sequence[str]) -> None:
    """Print a table, and write it as JSON and Markdown."""
    title = f"{name}: {EXPERIMENTS[name].title}"
    columns, about = list(seqs), f"here: preset {Path(runs.preset).stem}, {runs.config.steps} steps"
    if name == "table3":
        columns, rows = across_sessions_rows(runs, seqs[0], _sessions(command), command.baselines)
        caption = f"{about}, without drive {seqs[0]}; Recall@1 within 5 m"
    else:
        rows = f1max_rows(name, runs, seqs, command.baselines)
        caption = f"{about}, leave-one-out; top-1 F1max, 3 m / 20 m"
    if any(row.source == tables.PUBLISHED for row in rows):
        caption += "; published: the paper's numbers, on the real dataset"
    console().print(tables.rich_table(title, rows, columns, caption=caption))
    write_text(command.out / f"{name}.md", tables.markdown(title, rows, columns, caption=caption))
    write_json(command.out / f"{name}.json", tables.as_json(rows, columns))


def _make_pictures(name: str, command: ReproduceCommand, runs: Runs, seqs: Sequence[str]) -> None:
    """Draw the pictures of a figure, one for each drive where it has several."""
    drawings = {
        "figure5": lambda: pictures.precision_recall(
            {
                seq: {label: top1(runs, method, seq) for method, label in methods_of(name, command.baselines).items()}
                for seq in seqs
            }
        ),
        "figure6": lambda: pictures.trajectories(runs, {seq: top1(runs, FULL, seq) for seq in seqs}),
        "figure7": lambda: pictures.semantic_maps(runs, seqs),
        "figure8": lambda: pictures.feature_heat_maps(runs, seqs[0], [runs.drive(seqs[0]), _last_session(command)]),
        "figure9": lambda: pictures.categories(lambda variant, seq: top1(runs, variant, seq).score, seqs),
    }
    for file, picture in drawings[name]().items():
        figures.save(picture, command.out / file)
        print(f"written: {command.out / file}")


def _sessions(command: ReproduceCommand) -> Path:
    return command.nclt or cached_sessions()


def _last_session(command: ReproduceCommand) -> Drive:
    root = _sessions(command)
    return open_sequence(root, sequence_names(root)[-1])


def main() -> None:
    """The entry point."""
    run(lambda: reproduce(parse()))


if __name__ == "__main__":
    main()
