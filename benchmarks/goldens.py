"""Run the commands on small simulated data, and compare all that they write with an earlier run, for a refactoring.

    python -m benchmarks goldens build/before                            # before the change
    python -m benchmarks goldens build/after --beside build/before       # after it: every file has the same bytes
    python -m benchmarks goldens build/after --beside build/before --within 1e-6    # numbers may differ by this

The commands simulate three towns, a car park and a walker in a yard. They search loops, also between two halves of a
town (every second scan), correct a trajectory, build a map and find a scan in it, score two methods, and train two
presets for 20 steps. With --beside, the map and the descriptors of the earlier run are read, too. Files with times or
paths are left out, and so are pages and pictures.
"""

import os
import re
import shlex
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import safetensors.numpy
import tyro
from jaxtyping import Shaped

from benchmarks.timing import run_command

TOWNS = ("08", "00", "06")
SCANS = Path("towns", "sequences", "00", "velodyne")
SCAN = SCANS / "000040.bin"
POSE, SCORES = "pose-in-earlier-map.json", "scores-of-earlier-descriptors"
LIDAR = "--sensor vlp16 --azimuth-steps 450"
OF_TIME = ("command.json", "config.json", "environment.json", "throughput.json")
"""Names of files with times, versions or paths."""
TEXT = (".csv", ".g2o", ".json", ".jsonl", ".kitti", ".tum", ".txt")
NUMBER = re.compile(r"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")
SECONDS = re.compile(r'"[a-z_]*(?:seconds?|_s|time|wait)": [-+.\de]+')


def simulations() -> Iterator[str]:
    """Commands that simulate the data."""
    simulate = f"simulate --scans 90 {LIDAR}"
    yield f"{simulate} --out towns --seq {' '.join(TOWNS)}"
    yield f"{simulate} --out car_park --scenery car_park --seq 00"
    yield f"{simulate} --out yard --scenery yard --carrier backpack --seq 00"


def steps(before: Path | None) -> Iterator[str]:
    """Commands that read the data. `before` is the folder of an earlier run whose files are read again."""
    for data, seq in (*(("towns", seq) for seq in TOWNS), ("car_park", "00"), ("yard", "00")):
        yield f"loops {data} --seq {seq} --out loops/{data}-{seq}"
    odometry = "--odometry towns/sequences/00/poses.txt --odometry-format kitti --optimize"
    yield f"loops towns --seq 00 --out loops/odometry {odometry}"
    yield "loops halves/0 halves/1 --out loops/halves"
    yield "map towns --seq 00 --poses towns/sequences/00/poses.txt --pose-format kitti --out town.safetensors"
    yield f"relocalize {SCAN} --map town.safetensors --out pose.json"
    for method in ("sglpr", "scan-context"):
        yield f"embed --data towns --seq 00 --method {method} --out {method}.npz"
        yield f"evaluate {method}.npz --out {method}"
    for preset in ("sglpr-small", "sglpr"):
        yield f"train --data towns --seq 08 --preset {preset} --out train-{preset} --steps 20 --score-every 20"
    if before is not None:
        earlier_map, earlier = (shlex.quote(str(before / name)) for name in ("town.safetensors", "sglpr.npz"))
        yield f"relocalize {SCAN} --map {earlier_map} --out {POSE}"
        yield f"evaluate {earlier} --out {SCORES}"


def main(out: tyro.conf.Positional[Path], *, beside: Path | None = None, within: float = 0.0) -> None:
    """Run the commands, and compare.

    Args:
        out: new folder for all that is written.
        beside: folder of an earlier run to compare with.
        within: largest difference of two numbers, relative to the larger one, or absolute below 1.
    """
    if out.exists():
        raise SystemExit(f"{out}: expected a new folder")
    out.mkdir(parents=True)
    for line in simulations():
        _run(line, out)
    for number, scan in enumerate(sorted((out / SCANS).iterdir())):
        half = out / "halves" / str(number % 2)
        half.mkdir(parents=True, exist_ok=True)
        shutil.copy(scan, half)
    for line in steps(None if beside is None else beside.resolve()):
        _run(line, out)
    if beside is None:
        return
    different = [] if text_of(out / POSE) == text_of(out / "pose.json") else ["the pose in the earlier map differs"]
    (out / POSE).unlink()
    shutil.rmtree(out / SCORES)
    different += differences(beside, out, within=within)
    print(*(different or ["everything is the same"]), sep="\n")
    if different:
        raise SystemExit(1)


def _run(line: str, folder: Path) -> None:
    """Run a command line in the folder of the goldens."""
    print(line, flush=True)
    command, *arguments = shlex.split(line)
    program = (Path(__file__).parents[1] / "bin" / command, *arguments)
    run_command(program, os.environ | {"JAX_PLATFORMS": "cpu"}, folder)


def differences(before: Path, after: Path, *, within: float) -> list[str]:
    """One line for each file that differs between two folders, or exists in only one of them."""
    names = [set(map(str, _compared(folder))) for folder in (before, after)]
    lines = [f"{name}: in one folder only" for name in sorted(names[0] ^ names[1])]
    for name in sorted(names[0] & names[1]):
        if not same(before / name, after / name, within=within):
            lines.append(f"{name}: differs")
    return lines


def _compared(folder: Path) -> Iterator[Path]:
    """Files that do not change from run to run, relative to a folder."""
    for path in folder.rglob("*"):
        if path.is_file() and path.name not in OF_TIME and "checkpoints" not in path.parts:
            yield path.relative_to(folder)


def same(first: Path, second: Path, *, within: float) -> bool:
    """Whether two files are equal or, if `within` is not 0, differ only in numbers and by at most `within`.

    Pages and pictures are not compared.
    """
    if first.suffix in (".html", ".png") or first.read_bytes() == second.read_bytes():
        return True
    if first.suffix not in (*TEXT, ".npz", ".safetensors"):
        return False
    one, other = _arrays(first), _arrays(second)
    return set(one) == set(other) and all(_near(one[key], other[key], within=within) for key in one)


def _arrays(path: Path) -> dict[str, np.ndarray]:
    """Arrays of a file. A text becomes the array of its numbers and the text without them."""
    if path.suffix == ".safetensors":
        return safetensors.numpy.load_file(path)
    if path.suffix == ".npz":
        with np.load(path) as file:
            return dict(file)
    text = text_of(path)
    return {"numbers": np.array(NUMBER.findall(text), np.float64), "text": np.array(NUMBER.sub("#", text))}


def _near(one: Shaped[np.ndarray, "..."], other: Shaped[np.ndarray, "..."], *, within: float) -> bool:
    """Whether numbers differ by at most `within`, relative to the first ones, or absolutely below 1."""
    if np.array_equal(one, other):
        return True
    numeric = one.dtype.kind in "fiu" and other.dtype.kind in "fiu" and one.shape == other.shape
    return within > 0 and numeric and bool((np.abs(one - other) <= within * np.maximum(1.0, np.abs(one))).all())


def text_of(path: Path) -> str:
    """Text of a file without its durations and rates."""
    return SECONDS.sub('""', path.read_text())
