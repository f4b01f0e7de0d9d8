"""The commands that write files, on inputs so small that each takes a second, for `disturbed`.

A command runs in a process forked from this one, which has imported its module but never started JAX: so it starts in
no time, and whoever kills it meets it at its work.
"""

import contextlib
import ctypes
import dataclasses
import fnmatch
import importlib
import multiprocessing
import os
import resource
import struct
import sys
from collections.abc import Iterable
from multiprocessing.context import ForkProcess as Process
from pathlib import Path

INPUTS = "inputs"
"""The folder of what the commands read, beside the folders in which they write."""
OUT = "out"
"""What a command writes goes in here, in the folder that it is started in; so its name is always the same."""
ERRORS = "stderr"
TIMEOUT_S = 900
TINY = "tiny"
"""The preset that trainings take."""
DRIVE = "--azimuth-steps 60 --sensor vlp16"
SCANS = "sequences/08/velodyne"
TOWN = f"../{INPUTS}/town"
POSES = f"{TOWN}/sequences/08/poses.txt"


@dataclasses.dataclass(frozen=True)
class Writer:
    """A command that writes into `OUT`."""

    name: str
    line: str
    """Its arguments."""
    varies: tuple[str, ...] = ()
    """Patterns of files below `OUT` with times in them, that grow, or that only a killed run leaves for the next."""
    resumed_by: str = ""
    """Where this file is there already, --resume has it go on."""
    refuses: str = ""
    """What the error says where the command has done its work before and never does it twice."""

    def begin(self, folder: Path, **options) -> Process:
        """Start it in its folder, or have it go on with what lies there. The options are those of `start`."""
        (folder / OUT).mkdir(parents=True, exist_ok=True)
        resume = self.resumed_by and (folder / OUT / self.resumed_by).exists()
        return start(self.name.split()[0], (*self.line.split(), *["--resume"] * bool(resume)), folder, **options)

    def differing(self, found: dict[str, bytes], whole: dict[str, bytes], *, complete: bool = False) -> list[str]:
        """The files that are not as in an undisturbed run, less those that vary; missing ones if `complete`."""
        names = {**found, **whole} if complete else found
        unlike = [name for name in names if found.get(name) != whole.get(name)]
        return [name for name in unlike if not any(fnmatch.fnmatch(name, pattern) for pattern in self.varies)]


RUN_FILES = ("*/checkpoints/*", "*/environment.json", "*/metrics.jsonl", "*/learning-curves.png", "*/mining/*")
TRAINED = f"--seq 08 --data {TOWN} --preset {TINY} --steps 8 --method solid"
WRITERS = {
    writer.name: writer
    for writer in (
        Writer("embed", f"--weights circular --data {TOWN} --seq 08 --out {OUT}/08.npz"),
        Writer("evaluate", f"../{INPUTS}/08.npz --data {TOWN} --seq 08 --out {OUT}/08"),
        Writer("simulate", f"--out {OUT}/town {DRIVE} --seq 08 --scans 12"),
        Writer("simulate images", f"--out {OUT}/town {DRIVE} --seq 08 --scans 12 --images"),
        Writer("export", f"--weights circular --out {OUT}/mine", refuses="not exist yet"),
        Writer("export stablehlo", f"--weights circular --format stablehlo --out {OUT}/mine", refuses="not exist yet"),
        Writer(
            "map",
            f"{TOWN} --seq 08 --poses {POSES} --pose-format kitti --out {OUT}/town.safetensors",
            varies=("town.unfinished/*",),
        ),
        Writer(
            "map more",
            f"{TOWN} --seq 05 --poses {POSES.replace('08', '05')} --pose-format kitti "
            f"--add-to ../{INPUTS}/town.safetensors --out {OUT}/town.safetensors",
            varies=("town.unfinished/*",),
        ),
        Writer("relocalize", f"{TOWN}/{SCANS}/000003.bin --map ../{INPUTS}/town.safetensors --out {OUT}/pose.json"),
        Writer(
            "loops",
            f"{TOWN} --seq 08 --odometry {POSES} --odometry-format kitti --out {OUT}/found",
            varies=("found/unfinished/*",),
        ),
        Writer("segment", f"--weights sglpr --data {TOWN} --seq 08 --out {OUT}/maps"),
        Writer(
            "train",
            f"{TRAINED} --out {OUT}/run --cache {OUT}/packs",
            varies=RUN_FILES,
            resumed_by="run/config.json",
        ),
        Writer("reproduce", f"table1 {TRAINED} --out {OUT}/paper", varies=RUN_FILES),
    )
}


def make_inputs(folder: Path) -> None:
    """Write what the commands read: a town of two drives, a descriptor file and a map."""
    inputs = folder / INPUTS
    inputs.mkdir(parents=True)
    for line in (
        f"simulate --out town {DRIVE} --seq 05 08 --scans 24 --rate-hz 1",
        "embed --method solid --data town --seq 08 --out 08.npz",
        "map town --seq 08 --poses town/sequences/08/poses.txt --pose-format kitti --out town.safetensors",
    ):
        command, *arguments = line.split()
        assert ended(start(command, arguments, inputs)) == 0, said(inputs)
    (inputs / ERRORS).unlink()


def start(
    command: str,
    arguments: Iterable[str],
    folder: Path,
    *,
    errors: str = ERRORS,
    file_bytes: int | None = None,
    humble: bool = False,
) -> Process:
    """Start a command in a folder. What it says on stderr goes to the file `errors` there.

    No file may grow beyond `file_bytes`. A `humble` process may not write where its user may not, be that root.
    """
    cache = folder.parent / "cache"
    os.environ |= {
        "XDG_CACHE_HOME": str(cache),
        "JAX_PLATFORMS": "cpu",
        "JAX_COMPILATION_CACHE_DIR": str(cache / "xla"),
    }
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.1"
    cli = importlib.import_module("sglpr_jax.cli.__main__")
    cli.load_command(command)  # imported once, for all processes

    def work() -> None:
        os.chdir(folder)
        sys.argv = ["sglpr_jax.cli", command, *arguments]
        for stream, path in ((1, os.devnull), (2, errors)):
            os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), stream)
        if file_bytes is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (file_bytes, file_bytes))
        if humble:  # without any capability, as capset(2) has it
            assert ctypes.CDLL(None).capset(struct.pack("Ii", 0x20080522, 0), bytes(24)) == 0
        cli.main()

    process = multiprocessing.get_context("fork").Process(target=work)
    process.start()
    return process


def ended(process: Process) -> int:
    """Wait for a process; its exit status, negative where a signal ended it."""
    process.join(TIMEOUT_S)
    assert process.exitcode is not None, f"it has not ended after {TIMEOUT_S} s"
    return process.exitcode


def said(folder: Path, errors: str = ERRORS) -> str:
    """What a command said on stderr."""
    with contextlib.suppress(FileNotFoundError):
        return (folder / errors).read_text()
    return ""


def written(folder: Path) -> dict[str, bytes]:
    """What lies under its final name below `OUT`, by its path."""
    out, found = folder / OUT, {}
    for path in sorted(out.rglob("*")):
        name = str(path.relative_to(out))
        if path.is_file() and not any(part.startswith(".") for part in path.relative_to(out).parts):
            found[name] = path.read_bytes()
    return found
