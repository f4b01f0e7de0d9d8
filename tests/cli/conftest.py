"""Command lines run in this process, on datasets and with a model that take seconds."""

import contextlib
import io
import json
import os
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from PIL import Image

from sglpr_jax.cli.__main__ import main
from sglpr_jax.data.formats.pose_files import read_kitti
from sglpr_jax.pose_graph.files import write_tum
from sglpr_jax.sim.dataset import simulate
from sglpr_jax.sim.sensor import Sensor

SCANS, WALK = 40, 8
SENSOR = Sensor(elevations_deg=(2.0, -2.0, -6.0, -10.0, -14.0, -18.0, -21.0, -24.0), azimuth_steps=60)
TINY = Path(__file__).resolve().parents[1] / "tiny.py"


class Ended(NamedTuple):
    """How a command line ended: its exit status and what it printed."""

    status: int
    out: str
    error: str


def run_command(name: str, *arguments: object) -> Ended:
    """Run `bin/<name> <arguments>` in this process."""
    out, error = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(out), contextlib.redirect_stderr(error):
        patch.setattr(sys, "argv", ["sglpr_jax.cli", name, *map(str, arguments)])
        try:
            main()
            status = 0
        except SystemExit as end:
            status = end.code if isinstance(end.code, int) else 1
            if isinstance(end.code, str):
                print(end.code, file=sys.stderr)  # as Python does
    return Ended(status, out.getvalue(), error.getvalue())


def assert_one_line_error(ended: Ended, *words: object) -> None:
    """The command refused its input: status 1, and the last line is the error, with all of `words` in it."""
    assert ended.status == 1, ended
    last = ended.error.rstrip("\n").splitlines()[-1]
    assert last.startswith("error: "), ended.error
    assert "Traceback" not in ended.error
    assert not [str(word) for word in words if str(word) not in last], last


@pytest.fixture(scope="session", autouse=True)
def _own_cache(tmp_path_factory):
    """Simulated recordings go to a folder of this session, not to the user's."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(os.environ, "XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="session")
def town(once) -> Path:
    """Recordings 00, 05 and 08 of 40 thin scans, with labels; 08 revisits places."""
    return once("town", lambda root: simulate(root, scans=SCANS, sensor=SENSOR))


@pytest.fixture(scope="session")
def walk(town, once) -> Path:
    """Folder with `scans`, the first 8 scans of 08 twice, without times, and their true poses in `poses.tum`."""

    def make(root: Path) -> None:
        (root / "scans").mkdir(parents=True)
        for number in range(2 * WALK):
            scan = town / f"sequences/08/velodyne/{number % WALK:06d}.bin"
            shutil.copy(scan, root / "scans" / f"{number:06d}.bin")
        poses = read_kitti(town / "sequences/08/poses.txt")[:WALK]
        write_tum(root / "poses.tum", np.concatenate([poses, poses]), np.arange(2.0 * WALK))

    return once("walk", make)


@pytest.fixture(scope="session")
def images(tmp_path_factory) -> Path:
    """Ready-made BEV images of two straight recordings, 00 and 06, which never come back."""
    root = tmp_path_factory.mktemp("data") / "images"
    write_images(root)
    return root


@pytest.fixture(scope="session")
def labelled_images(tmp_path_factory) -> Path:
    """The same with label images: buildings where an image is bright, moving cars where it is not, and empty cells."""
    root = tmp_path_factory.mktemp("data") / "labelled"
    write_images(root, labels=True)
    return root


def write_images(root: Path, *, labels: bool = False) -> None:
    rng = np.random.default_rng(0)
    for name in ("00", "06"):
        for what in ("imgs", "labels") if labels else ("imgs",):
            (root / name / what).mkdir(parents=True)
        poses = np.tile(np.eye(3, 4), (30, 1, 1))
        poses[:, 0, 3] = 6.0 * np.arange(30)
        np.savetxt(root / name / "pose.txt", poses.reshape(30, 12))
        for frame in range(30):
            picture = rng.integers(0, 255, (20, 22), dtype=np.uint8)
            if labels:
                picture[picture < 50] = 0
                raw = np.where(picture > 150, 50, 252) * (picture > 0)
                Image.fromarray(raw.astype(np.uint16)).save(root / name / "labels" / f"{frame:06d}.png")
            Image.fromarray(picture).save(root / name / "imgs" / f"{frame:06d}.png")


@pytest.fixture(scope="session")
def preset() -> Path:
    """A preset that is no file of configs/: a model of next to no arithmetic, four steps."""
    return TINY


class Trained(NamedTuple):
    """A training run and what its command printed."""

    folder: Path
    ended: Ended


@pytest.fixture(scope="session")
def trained(town, preset, once) -> Trained:
    """The run that several tests look at; nobody changes it."""

    def make(root: Path) -> None:
        ended = run_command("train", "--seq", "08", "--data", town, "--preset", preset, "--out", root / "tiny-08")
        assert ended.status == 0, ended.error
        (root / "ended.json").write_text(json.dumps(ended))

    root = once("runs", make)
    return Trained(root / "tiny-08", Ended(*json.loads((root / "ended.json").read_text())))


@pytest.fixture
def command() -> Callable[..., Ended]:
    """`command(name, *arguments)` runs a command line in this process."""
    return run_command
