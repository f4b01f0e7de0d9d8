"""bin/reproduce: reproduce the paper's tables and figures on any dataset, beside the paper's numbers."""

import dataclasses
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from sglpr_jax.cli.config_file import record_command
from sglpr_jax.cli.runtime import console
from sglpr_jax.cli.train import exit_unless_finished
from sglpr_jax.data.choices import PoseChoice
from sglpr_jax.files import check_still_there
from sglpr_jax.progress import progress_bar
from sglpr_jax.reproduce.experiments import EXPERIMENTS
from sglpr_jax.stop_request import stop_on_signal
from sglpr_jax.training.config import TrainConfig

if TYPE_CHECKING:
    from sglpr_jax.reproduce.plan import Plan
    from sglpr_jax.reproduce.reproduction import Reproduction

    ExperimentName = str
else:
    ExperimentName = Literal[("all", *EXPERIMENTS)]
PAPER_SEQUENCES = ("00", "02", "05", "06", "07", "08")


@dataclasses.dataclass(frozen=True)
class ReproduceCommand:
    """Reproduce tables and figures of the paper: train missing models, embed, evaluate, print the results beside the
    paper's.

    Every test recording has its own models, trained on all other recordings (leave-one-out), one for each variant of a
    table. Finished runs in --out are reused, and interrupted runs are resumed.

    Example:
      bin/reproduce table4 figure9 --plan                          prints the missing trainings and their duration
      bin/reproduce all                                            on the simulated recordings, preset sglpr
      bin/reproduce table1 table2 --data KITTI --preset paper
      bin/reproduce table1 table2 --data KITTI --weights sglpr runs/rinet --no-train
    """

    what: tyro.conf.Positional[tuple[ExperimentName, ...]]
    """Names of tables and figures."""
    data: Path | None = None
    """Folder of the dataset: KITTI's layout, or ready-made BEV images. None: the simulated recordings."""
    nclt: Path | None = None
    """Sessions in NCLT's layout, for table 3 and figure 8. The first is the database. None: simulated sessions."""
    preset: str = "sglpr"
    """Name of a file in configs/, or path of your own file."""
    seq: tuple[str, ...] = ()
    """Recordings to test on. If omitted, those of 00, 02, 05, 06, 07 and 08 that the dataset contains."""
    out: Path = Path("runs/reproduce")
    """Folder for the runs, tables and pictures."""
    method: tuple[str, ...] = ("m2dp", "scan-context", "lidar-iris", "ssc", "solid", "polar-fft")
    """Handcrafted methods in tables 1 to 3 and figure 5. On ready-made images, only polar-fft works."""
    weights: tuple[str, ...] = ()
    """Further weights in tables 1 to 3 and figure 5: names of shipped weights, or folders of bin/train or bin/peers.
    They may have been trained on the tested recordings; this is not checked."""
    train: bool = True
    """Train the variants of the tables and figures. Otherwise, only --weights and --method are compared."""
    pose_source: PoseChoice = "auto"
    """Pose files of KITTI's layout: SemanticKITTI's (sequences/NN/poses.txt) or KITTI's own (poses/NN.txt)."""
    plan: bool = False
    """Only print the missing trainings."""
    config: Annotated[TrainConfig, tyro.conf.arg(name=""), tyro.conf.FlagConversionOff, tyro.conf.AvoidSubcommands] = (
        dataclasses.field(default_factory=TrainConfig)
    )


def reproduce(command: ReproduceCommand) -> None:
    from sglpr_jax.cli.datasets import dataset_root  # slow imports, not needed for --help
    from sglpr_jax.data.readers import recording_names
    from sglpr_jax.reproduce.plan import check_inputs, make_plan, time_a_step
    from sglpr_jax.reproduce.reproduction import Reproduction

    names = list(EXPERIMENTS if "all" in command.what else dict.fromkeys(command.what))
    root = dataset_root(command.data, write=not command.plan)
    reproduction = Reproduction(
        folder=command.out,
        data=root,
        preset=command.preset,
        config=command.config,
        seqs=command.seq or tuple(seq for seq in PAPER_SEQUENCES if seq in recording_names(root)),
        methods=command.method,
        weights=command.weights,
        sessions=lambda: dataset_root(command.nclt, sessions=True),
        trained=command.train,
        pose_source=command.pose_source,
        progress=progress_bar,
    )
    check_inputs(reproduction, names, command.nclt)
    if command.train or command.plan:
        plan = make_plan(reproduction, names if command.train else [])
        seconds_per_step = None
        if plan.missing:
            print("measuring the duration of a training step, after its compilation", file=sys.stderr)
            seconds_per_step = time_a_step(reproduction, *plan.missing[0])
        print(plan.text(seconds_per_step), file=sys.stderr)
        if command.plan:
            return
        _train_missing(reproduction, plan)
    recorded = record_command(command, command.out)
    _write_results(reproduction, names)
    check_still_there(recorded)


def _train_missing(reproduction: "Reproduction", plan: "Plan") -> None:
    """Train the missing runs: a variant of the network and the recording to test on. Exits if a signal stops one."""
    for number, (variant, seq) in enumerate(plan.missing, start=1):
        print(f"run {number} of {len(plan.missing)}: {variant}, {seq}", file=sys.stderr)
        with stop_on_signal() as stopped:
            result = reproduction.train(variant, seq, stopped=stopped)
        print(result, file=sys.stderr)
        exit_unless_finished(result, stopped, stop_advice="run the same command again to continue")


def _write_results(reproduction: "Reproduction", names: list[str]) -> None:
    """Compute, write and print the tables and figures with these names (`table1`, `figure5`) from finished runs."""
    from sglpr_jax.reproduce.figures import FIGURES, write_figures
    from sglpr_jax.reproduce.tables import write_tables

    for name in names:
        if name in FIGURES:
            for path in write_figures(reproduction, name):
                print(f"written: {path}")
        else:
            for table in write_tables(reproduction, name):
                console().print(table)
