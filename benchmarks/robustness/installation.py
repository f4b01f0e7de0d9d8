"""Whether the library can be installed: wheels of every dependency, and the README followed by its letter."""

import datetime
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
import urllib.error
import urllib.request
from pathlib import Path
from typing import Literal, NamedTuple

ROOT = Path(__file__).resolve().parents[2]
PLATFORMS = {
    "Linux x86_64": "x86_64-manylinux_2_28",
    "Linux aarch64": "aarch64-manylinux_2_28",
    "macOS arm64": "aarch64-apple-darwin",
    "macOS x86_64": "x86_64-apple-darwin",
    "Windows amd64": "x86_64-pc-windows-msvc",
}
"""Names of platforms, with uv's name of each."""
PYTHONS = ("3.11", "3.12", "3.13")
NOT_OF_USERS = ("dev",)
"""Extras of those who work on the library itself."""
UNAVAILABLE = re.compile(r"\b([A-Za-z][\w.-]*?)(?:[<>=!]\S*)? (?:has|have) no (?:usable )?wheels")
MACOS = "14.0"
"""Version of macOS. By default uv takes 13.0, for which small-gicp has no wheel."""
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


def platforms(
    *,
    pythons: tuple[str, ...] = PYTHONS,
    platforms: tuple[str, ...] = tuple(PLATFORMS),
    extras: tuple[str, ...] = (),
) -> None:
    """Print a Markdown table of platforms with wheels of every dependency, and what is missing.

    Each extra of pyproject.toml is resolved with all that it needs, from wheels only. Nothing is installed. The program
    is `uv pip compile` (pip install uv): unlike pip, it applies the conditions of the other platform.

    Args:
        pythons: versions of Python.
        platforms: names in `PLATFORMS`.
        extras: extras of pyproject.toml; without them all, and what is required.
    """
    if shutil.which("uv") is None:
        sys.exit("expected the program uv, found none; pip install uv")
    project, reasons = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"], set[str]()
    wanted = {"required": project["dependencies"], **project["optional-dependencies"]}
    print(f"{datetime.date.today()}, Python {', '.join(pythons)}\n\n| | {' | '.join(platforms)} |")
    print("|---" * (len(platforms) + 1) + "|")
    for extra, needs in wanted.items():
        if extra in NOT_OF_USERS or (extras and extra not in extras):
            continue
        cells = []
        for platform in platforms:
            missing = {python: _missing(needs, platform, python) for python in pythons}
            names = dict.fromkeys(name for found in missing.values() for name in found)
            lacking = {name: [python for python in pythons if name in missing[python]] for name in names}
            texts = (name if len(of) == len(pythons) else f"{name} ({', '.join(of)})" for name, of in lacking.items())
            cells.append(f"no {', '.join(texts)}" if names else "yes")
            reasons |= {f"{platform}, {name}: {why}" for found in missing.values() for name, why in found.items()}
        print(f"| `{extra}` | {' | '.join(cells)} |", flush=True)
    print("", *sorted(reasons), sep="\n")


def _missing(needs: list[str], platform: str, python: str) -> dict[str, str]:
    """Requirements without a wheel, and why. All are tried together first, and singly if that fails."""
    if not _reason_against(needs, platform, python):
        return {}
    each = {re.split(r"[\[<>=!; ]", need)[0]: _reason_against([need], platform, python) for need in needs}
    found = {name: reason for name, reason in each.items() if reason}
    return found or {" with ".join(needs): "their needs contradict each other"}


def _reason_against(needs: list[str], platform: str, python: str) -> str:
    """An empty text if wheels of all requirements fit the platform, else why not."""
    command = ["uv", "pip", "compile", "-", "--quiet", "--no-config", "--only-binary", ":all:", "--color", "never"]
    command += ["--python-platform", PLATFORMS[platform], "--python-version", python]
    environment = os.environ | {"MACOSX_DEPLOYMENT_TARGET": MACOS}
    done = subprocess.run(command, input="\n".join(needs), env=environment, capture_output=True, text=True)
    if not done.returncode:
        return ""
    if "No solution found" not in done.stderr:
        sys.exit(f"{', '.join(needs)} for {platform}: {done.stderr}")
    found = UNAVAILABLE.search(" ".join(done.stderr.split()))
    return f"no wheel of {found[1]}" if found else " ".join(done.stderr.split())


class Step(NamedTuple):
    """A command of the README, and the line of the block that it stands in."""

    line: int
    command: list[str]
    shown: str


def readme(*, of: Literal["clone", "wheel"] = "clone", but: tuple[str, ...] = (), scans: int = 200) -> None:
    """Run each block of the README in order, and print the seconds it takes. It ends at the first failure.

    The commit that is checked out is cloned into a new folder, with a home of its own and empty caches; or a wheel of
    it is installed into a new environment, and bin/embed is sglpr-embed. What the README takes for granted (KITTI,
    my_scans, odometry.tum) is simulated there. Takes hours: bin/test and a training are among the blocks.

    Args:
        of: a clone or a wheel.
        but: commands that are left out, such as bin/test.
        scans: scans of each simulated recording.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        environment = {key: value for key, value in os.environ.items() if key in KEPT or key.startswith("PIP_")}
        environment |= {"HOME": str(folder / "home"), "PIP_NO_CACHE_DIR": "1"}
        (folder / "home").mkdir()
        start = time.perf_counter()
        place, python = _prepared(folder, of, environment)
        seconds = time.perf_counter() - start
        _make_data(place, python, of, scans, environment)
        print(f"| line | command | seconds |\n|---|---|---|\n| | (until it is there) | {seconds:.1f} |")
        for step in _steps((ROOT / "README.md").read_text(), python, of_wheel=of == "wheel"):
            if not any(step.shown.startswith(other) for other in but):
                print(f"| {step.line} | `{step.shown}` | {_followed(step, place, environment):.1f} |", flush=True)


def _prepared(folder: Path, of: str, environment: dict[str, str]) -> tuple[Path, Path]:
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


def _make_data(place: Path, python: Path, of: str, scans: int, environment: dict[str, str]) -> None:
    """Write KITTI/, my_scans/ and odometry.tum, which the reader has."""
    simulate = "bin/simulate" if of == "clone" else "sglpr-simulate"
    _run([simulate, "--out", "KITTI", "--scans", str(scans), "--azimuth-steps", "900"], place, environment)
    (place / "my_scans").mkdir()
    for scan in sorted((place / "KITTI/sequences/08/velodyne").iterdir())[:50]:
        shutil.copy(scan, place / "my_scans")
    _run([str(python), "-c", ODOMETRY], place, environment)


def _steps(text: str, python: Path, *, of_wheel: bool) -> list[Step]:
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


def _followed(step: Step, place: Path, environment: dict[str, str]) -> float:
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
