"""Each benchmark starts and prints at its smallest size. Numbers are not tested."""

import functools
import importlib
import os
import shlex
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from sglpr_jax.sim.dataset import simulate
from sglpr_jax.sim.sensor import Sensor
from tests.docs.pages import PAGES, blocks, command_lines

ROOT = Path(__file__).resolve().parents[2]
SENSOR = Sensor(elevations_deg=(2.0, -2.0, -8.0, -16.0), azimuth_steps=90)
TINY = f"{ROOT}/tests/tiny.py"
"""A preset of next to no arithmetic."""
SMALL, LIGHT = "--scans 12 --azimuth-steps 90", "--weights sglpr-small"
RUN = (
    "methods baselines --data town --methods solid --frames 100",
    f"loops --world walls --route same --sensor vlp16 --method sglpr scan-context {SMALL} {LIGHT} --out d",
    "loops evidence d --sensor vlp16 --weights sglpr-small",
    "sensors rotation --data images --weights sglpr-small --scans 2 --step-deg 120 --among 20",
    "realism compare --real town --simulated images --scans 2 --out compared",
    f"speed training --preset {TINY} --size 64 --repeats 1 --steps 1",
    f"speed profile --preset {TINY} --steps 1",
    "speed loops --frames 40 --repeats 1 --azimuth-steps 90 --weights sglpr-small",
    "speed stages --scans 4 --rates 10 --weights sglpr-small",
    "maps moving --seeds 1 --sensors vlp16 --scans 6 --azimuth-steps 90",
    "fleet index --drives drawn.npz --places 2000 --queries 3",
    f"learned data --out learned --only test/town-601 train-images/vlp16-61 {SMALL}",
    f"learned sampler --data learned --part train-images {LIGHT}",
    "learned score ring --data learned --only town-601-00",
    "learned cost rinet@random:0 --data learned --scans 1",
    "learned leaderboard --build learned --kept kept.json --page page.md --figure figure.svg",
)
"""In order: some read what others have written."""
PARSED = (
    "goldens build/before",
    "learned labels predicted --data learned --out predicted",
    "speed embed --scans 65",
    "speed start-up --repeats 1 --places 30 --commands embed",
)
"""Programs that run long and that no page shows, whose flags are parsed."""
START = "python -m benchmarks "


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A folder with small datasets."""
    made = tmp_path_factory.mktemp("benchmarks")
    simulate(made / "town", routes=("00",), scans=60, sensor=SENSOR)
    simulate(made / "images", routes=("08",), scans=60, sensor=SENSOR, images=True)
    np.savez(made / "drawn.npz", a=np.random.default_rng(0).normal(size=(40, 16)).astype(np.float32))
    (made / "kept.json").write_text((ROOT / "benchmarks/learned/results.json").read_text())
    return made


@pytest.fixture
def benchmarks(monkeypatch):
    """The program `python -m benchmarks`."""
    monkeypatch.syspath_prepend(str(ROOT))
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    return importlib.import_module("benchmarks.__main__")


def test_every_program_is_tested(benchmarks, capsys):
    """Those of the pages are parsed with the other blocks of code."""
    shown = [line for page in PAGES for block in blocks(page) for line in command_lines(block)]
    shown = [line.removeprefix(START) for line in shown if line.startswith(START)]
    named = {name for line in (*RUN, *PARSED, *shown) if (name := benchmarks.program_name(line.split()))}
    assert named == set(benchmarks.PROGRAMS)
    benchmarks.main([])
    assert set(benchmarks.PROGRAMS) == {line[:20].strip() for line in capsys.readouterr().out.splitlines()}


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize("line", RUN)
def test_a_program_runs(line, folder, benchmarks, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    benchmarks.main(line.split())
    assert capsys.readouterr().out.strip()


@pytest.mark.parametrize("line", PARSED)
def test_flags_are_parsed(line, benchmarks, monkeypatch):
    """The program's function is replaced by one of the same signature."""
    called = []
    load = benchmarks.Program.load
    monkeypatch.setattr(
        benchmarks.Program, "load", lambda one: functools.wraps(load(one))(lambda *args, **flags: called.append(flags))
    )
    benchmarks.main(shlex.split(line))
    assert len(called) == 1


def test_commands_for_a_gpu_are_parsed_without_tyro():
    """They run from a checkout that is not installed."""
    lines = ("simulate --out towns", "train --data towns --preset paper --out run --chunk 0", "measure --batch 1")
    check = "import sys; sys.modules['tyro'] = None; import benchmarks.gpu.commands; "
    check += "from benchmarks.gpu.__main__ import parser"
    check += "".join(f"; parser().parse_args({line.split()!r})" for line in lines)
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    subprocess.run((sys.executable, "-c", check), cwd=ROOT, env=environment, check=True)


@pytest.mark.slow
def test_presets_are_measured_as_on_a_gpu(folder, benchmarks, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    gpu = importlib.import_module("benchmarks.gpu.__main__")
    line = f"measure --preset {TINY} --compute float32 --batch 1 --repeats 1 --calls 1 --size 64 --products 1"
    gpu.main(line.split())
    gpu.main([*line.split(), "--minutes", "1"])  # all rows are there
    assert capsys.readouterr().out.count("presets: finished") == 2


@pytest.mark.slow
def test_a_recording_of_a_fleet_is_described(folder, benchmarks):
    """By the worker of the recipe for Ray."""
    describer = importlib.import_module("benchmarks.fleet.ray").Describer(
        out=f"{folder}/places/", weights="sglpr-small"
    )
    row = describer({"source": str(folder / "town")})
    assert (row["added"], row["error"]) == (60, "")
    assert describer({"source": str(folder / "nothing")})["error"]


def test_operations_are_counted_as_by_hand(benchmarks):
    count = importlib.import_module("benchmarks.speed.training").count_flops
    a, b = np.zeros((7, 3, 5), np.float32), np.zeros((7, 5, 4), np.float32)
    assert count(jax.jit(lambda a, b: a @ b).trace(a, b).jaxpr) == 2 * 7 * 3 * 5 * 4
    square = np.zeros((5, 5), np.float32)
    looped = jax.jit(lambda x: jax.lax.scan(lambda x, _: (x @ square, None), x, length=6)[0])
    assert count(looped.trace(square).jaxpr) == 6 * 250


def test_goldens_name_files_that_differ(tmp_path, benchmarks):
    goldens = importlib.import_module("benchmarks.goldens")
    before, after = tmp_path / "before", tmp_path / "after"
    for folder, x, seconds in ((before, 1.0, 3.2), (after, 1.0 + 1e-8, 4.5)):
        folder.mkdir()
        (folder / "poses.tum").write_text(f"0 {x:.9f} 0 0")
        (folder / "loss.jsonl").write_text(f'{{"loss": 2.5, "steps_per_second": {seconds}}}')
        np.savez(folder / "found.npz", x=np.array([x]), ids=np.array(["a"]))
    assert goldens.differences(before, after, within=0.0) == ["found.npz: differs", "poses.tum: differs"]
    assert goldens.differences(before, after, within=1e-6) == []
