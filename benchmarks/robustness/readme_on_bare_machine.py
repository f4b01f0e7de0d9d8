"""Follow the README by its letter, as somebody does who has nothing yet: each block in order, and the seconds it takes.

    python -m benchmarks.robustness.readme_on_bare_machine
    python -m benchmarks.robustness.readme_on_bare_machine --of wheel

The commit that is checked out is cloned into a new folder, with a home of its own and empty caches; or a wheel of it is
installed into a new environment, and bin/embed is sglpr-embed. What the README takes for granted (KITTI, my_scans,
odometry.tum) is simulated there. It ends at the first command that fails. Needs nothing but Python and git, and hours:
bin/test and a training are among the blocks (--but leaves commands out).
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]
KEPT = ("PATH", "LANG", "TMPDIR", "SSL_CERT_FILE", "REQUESTS_CA_BUNDLE")
"""What a new user's environment has too; beside these, how pip finds its index."""
NOT_INSTALLED = ("bin/test", "bin/docs", "pip install")
"""Blocks of whoever has a checkout."""
ODOMETRY = """
from pathlib import Path
import sglpr_jax
from sglpr_jax.pose_graph.files import write_tum
poses = sglpr_jax.read_odometry("KITTI/sequences/08/poses.txt", format="kitti")
write_tum(Path("odometry.tum"), poses, sglpr_jax.open_recording("KITTI", "08").times)
"""
MANUAL = "http://localhost:8000"
DOCS_S = 1200


class Step(NamedTuple):
    """A command of the README, and the line of the block that it stands in."""

    line: int
    command: list[str]
    shown: str


def main() -> None:
    """Parse the command line and follow the README."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--of", choices=("clone", "wheel"), default="clone")
    parser.add_argument("--but", nargs="*", default=[], help="commands that are left out, as bin/test")
    parser.add_argument("--scans", type=int, default=200, help="of each simulated recording")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        environment = {key: value for key, value in os.environ.items() if key in KEPT or key.startswith("PIP_")}
        environment |= {"HOME": str(folder / "home"), "PIP_NO_CACHE_DIR": "1"}
        (folder / "home").mkdir()
        start = time.perf_counter()
        place, python = prepared(folder, options.of, environment)
        seconds = time.perf_counter() - start
        make_data(place, python, options.of, options.scans, environment)
        print(f"| line | command | seconds |\n|---|---|---|\n| | (until it is there) | {seconds:.1f} |")
        for step in steps((ROOT / "README.md").read_text(), python, of_wheel=options.of == "wheel"):
            if not any(step.shown.startswith(other) for other in options.but):
                print(f"| {step.line} | `{step.shown}` | {followed(step, place, environment):.1f} |", flush=True)


def prepared(folder: Path, of: str, environment: dict[str, str]) -> tuple[Path, Path]:
    """Clone, or install a wheel; the folder to work in and the Python to come. `pip` is that of a new environment."""
    clone = folder / "clone"
    _run(["git", "clone", "--quiet", "--no-hardlinks", str(ROOT), str(clone)], folder, environment)
    venv = folder / "venv"
    _run([sys.executable, "-m", "venv", str(venv)], folder, environment)
    environment["PATH"] = f"{venv / 'bin'}:{environment['PATH']}"
    if of == "clone":
        return clone, clone / ".venv/bin/python"
    place = folder / "work"
    place.mkdir()
    build = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "-w", str(folder), str(clone)]
    _run(build, folder, environment)
    shutil.rmtree(clone)
    (wheel,) = folder.glob("*.whl")
    _run([str(venv / "bin/python"), "-m", "pip", "install", "--quiet", f"{wheel}[viz]"], folder, environment)
    return place, venv / "bin/python"


def make_data(place: Path, python: Path, of: str, scans: int, environment: dict[str, str]) -> None:
    """Write KITTI/, my_scans/ and odometry.tum, which the reader has."""
    simulate = "bin/simulate" if of == "clone" else "sglpr-simulate"
    _run([simulate, "--out", "KITTI", "--scans", str(scans), "--azimuth-steps", "900"], place, environment)
    (place / "my_scans").mkdir()
    for scan in sorted((place / "KITTI/sequences/08/velodyne").iterdir())[:50]:
        shutil.copy(scan, place / "my_scans")
    _run([str(python), "-c", ODOMETRY], place, environment)


def steps(text: str, python: Path, *, of_wheel: bool) -> list[Step]:
    """Each line of each bash block; each Python block, after those before it, whose names it uses."""
    found, before = [], ""
    for block in re.finditer(r"^```(\w*)\n(.*?)^```", text, re.MULTILINE | re.DOTALL):
        line = text.count("\n", 0, block.start()) + 1
        if block[1] == "python":
            before += block[2]
            found.append(Step(line, [str(python), "-c", before], f"Python, {len(block[2].splitlines())} lines"))
        elif block[1] == "bash":
            for shown in filter(None, (re.split(r"(?:^|\s)#\s", one)[0].strip() for one in block[2].splitlines())):
                if of_wheel and shown.startswith(NOT_INSTALLED):
                    continue
                command = re.sub(r"\bbin/(\w+)", r"sglpr-\1", shown) if of_wheel else shown
                found.append(Step(line, ["bash", "-c", command], command))
    return found


def followed(step: Step, place: Path, environment: dict[str, str]) -> float:
    """The seconds of a command; of the manual, which is served until it is stopped, those until it is there."""
    start = time.perf_counter()
    if step.shown != "bin/docs":
        _run(step.command, place, environment, shown=step.shown)
        return time.perf_counter() - start
    with subprocess.Popen(step.command, cwd=place, env=environment, start_new_session=True) as server:
        while not _is_there(MANUAL):
            if server.poll() is not None or time.perf_counter() - start > DOCS_S:
                sys.exit(f"`{step.shown}` (line {step.line}): expected the manual at {MANUAL}, found none")
            time.sleep(0.5)
        seconds = time.perf_counter() - start
        os.killpg(server.pid, 15)
    return seconds


def _is_there(address: str) -> bool:
    try:
        with urllib.request.urlopen(address, timeout=5) as answer:
            return answer.status == 200
    except (urllib.error.URLError, OSError):
        return False


def _run(command: list[str], folder: Path, environment: dict[str, str], *, shown: str = "") -> None:
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    if done.returncode:
        said = f"{done.stdout[-3000:]}{done.stderr[-3000:]}"
        sys.exit(f"`{shown or ' '.join(command)}` ended with {done.returncode}:\n{said}")


if __name__ == "__main__":
    main()
