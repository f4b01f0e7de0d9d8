"""Commands that write files, with small inputs, for the program that disturbs them (`disturbed.py`)."""

import dataclasses
from pathlib import Path

from sglpr_jax.data.readers import open_recording
from sglpr_jax.pose_graph.odometry_files import read_odometry
from sglpr_jax.se3 import quaternions
from tests.bags import CLOUD, ODOMETRY, cloud, pose, write_bag

INPUTS, OUT = "inputs", "out"
"""Folder of the input files, and output folder within the folder of a command."""
DRIVE = "--azimuth-steps 60 --sensor vlp16"
TOWN = f"../{INPUTS}/town"
SCANS = f"{TOWN}/sequences/08/velodyne"
BAG = "drive.bag"
"""Drive 08 of the town as a bag, a scan each second."""
POSES = f"--poses {TOWN}/sequences/%s/poses.txt --pose-format kitti"
TRAINED = f"--seq 08 --data {TOWN} --preset tiny --steps 8 --method solid"
RUN_FILES = ("*/checkpoints/*", "*/environment.json", "*/metrics.jsonl", "*/learning-curves.png", "*/mining/*")


@dataclasses.dataclass(frozen=True)
class Writer:
    """A command that writes into `OUT`."""

    line: str
    """Arguments."""
    varies: tuple[str, ...] = ()
    """Patterns of files below `OUT` that may differ between runs, for example because they contain times."""
    resumed_by: str = ""
    """File below `OUT`. If it exists, the command is started with --resume."""
    grows: tuple[str, ...] = ()
    """Patterns of files below `OUT` that are written line by line. Before the end, they hold the first lines."""
    refuses: str = ""
    """Part of the error of a command that refuses to run again after it has finished. Empty: it can run again."""


WRITERS = {
    "embed": Writer(f"--weights sglpr-small --data {TOWN} --seq 08 --out {OUT}/08.npz"),
    "evaluate": Writer(f"../{INPUTS}/08.npz --data {TOWN} --seq 08 --out {OUT}/08"),
    "simulate": Writer(f"--out {OUT}/town {DRIVE} --seq 08 --scans 12"),
    "simulate images": Writer(f"--out {OUT}/town {DRIVE} --seq 08 --scans 12 --images"),
    "export": Writer(f"--weights sglpr-small --out {OUT}/mine", refuses="not exist yet"),
    "export stablehlo": Writer(f"--weights sglpr-small --format stablehlo --out {OUT}/mine", refuses="not exist yet"),
    "map": Writer(f"{TOWN} --seq 08 {POSES % '08'} --out {OUT}/town.safetensors", varies=("town.unfinished/*",)),
    "map more": Writer(
        f"{TOWN} --seq 05 {POSES % '05'} --add-to ../{INPUTS}/town.safetensors --out {OUT}/town.safetensors",
        varies=("town.unfinished/*",),
    ),
    "relocalize": Writer(f"{SCANS}/000003.bin --map ../{INPUTS}/town.safetensors --out {OUT}/pose.json"),
    "loops": Writer(
        f"{TOWN} --seq 08 --odometry {TOWN}/sequences/08/poses.txt --odometry-format kitti --out {OUT}/found",
        varies=("found/unfinished/*",),
    ),
    "live": Writer(
        f"bag:../{INPUTS}/{BAG} --odometry-topic /odom --rate 0 --min-probability 0.05 --out {OUT}/map",
        varies=("map/frames.log",),
        grows=("map/loops.jsonl",),
    ),
    "segment": Writer(f"--weights sglpr --data {TOWN} --seq 08 --out {OUT}/maps"),
    "train": Writer(f"{TRAINED} --out {OUT}/run --cache {OUT}/packs", varies=RUN_FILES, resumed_by="run/config.json"),
    "reproduce": Writer(f"table1 {TRAINED} --out {OUT}/paper", varies=RUN_FILES),
}
"""Commands by name. The first word is the command in `bin/`."""
INPUT_LINES = (
    f"simulate --out town {DRIVE} --seq 05 08 --scans 24 --rate-hz 1",
    "embed --method solid --data town --seq 08 --out 08.npz",
    "map town --seq 08 --poses town/sequences/08/poses.txt --pose-format kitti --out town.safetensors",
)


def write_bag_of(town: Path, path: Path) -> None:
    """Writes scans and odometry of drive 08 into a bag."""
    recording, poses = open_recording(town, "08"), read_odometry(town / "sequences/08/poses.txt", format="kitti")
    turned, messages = quaternions(poses), []
    for row in range(len(recording)):
        at, points = 1e9 + row, recording.scan(row, labels=False).points
        assert points is not None
        messages.append(("/points", CLOUD, at, cloud("ros1", at, points[:, :3])))
        messages.append(("/odom", ODOMETRY, at, pose("ros1", at, poses[row, :3, 3], turned[row])))
    write_bag(path, "ros1", messages)
