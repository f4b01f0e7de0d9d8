"""The commands for a GPU, run on this device: what they write, that they go on where they stopped, and need no tyro."""

import importlib
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import jax
import pytest

from sglpr_jax.models.weights_file import load

from .programs import ROOT, TINY

pytestmark = pytest.mark.slow

PRESET = """
import dataclasses, runpy
from sglpr_jax.grid import Grid
TINY = runpy.run_path({tiny!r})["CONFIG"]
MODEL = dataclasses.replace(TINY.model, image="density", grid=Grid(0.4, 64, 64))
CONFIG = dataclasses.replace(TINY, model=MODEL)
"""
ALL_IN_ONE = """
import sys
sys.modules["tyro"] = None  # from now on importing it fails
from benchmarks.gpu.__main__ import main
for line in sys.argv[1:]:
    main(line.split())
import sglpr_jax
print(sglpr_jax.__file__)
"""
SIMULATE = (
    "simulate --out towns --seq 00 08 --scans 20 --sensor vlp16 --azimuth-steps 90 --batch 2 --points 500 --repeats 1"
)
TRAIN = "train --data towns --preset tiny.py --out runs/tiny --packs packs"
MEASURE = "measure --preset tiny.py --compute bfloat16 --batch 1 --repeats 2 --calls 1 --size 64 --products 1"


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> tuple[Path, str]:
    """The folder in which a process without tyro has run all three commands, and what it printed."""
    folder = tmp_path_factory.mktemp("made")
    (folder / "tiny.py").write_text(PRESET.format(tiny=str(TINY)))
    command = (sys.executable, "-W", "error", "-c", ALL_IN_ONE, SIMULATE, TRAIN, MEASURE)
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    return folder, done.stdout


@pytest.fixture
def begun(made, tmp_path, monkeypatch) -> Path:
    """A copy of that folder as the current one, to go on in."""
    shutil.copytree(made[0], tmp_path / "copy")
    monkeypatch.chdir(tmp_path / "copy")
    return tmp_path / "copy"


@pytest.fixture
def stop_after(monkeypatch):
    """`stop_after(n)`: time is over when it is asked after for the n-th time; `stop_after(None)`: never."""
    gpu = importlib.import_module("benchmarks.gpu.__main__")

    def limit(number: int | None) -> None:
        asked = iter(range(1, 10**6))
        monkeypatch.setattr(gpu, "time_limit", lambda minutes: lambda: number is not None and next(asked) >= number)

    return limit


def run(line: str) -> None:
    """A command in this process."""
    importlib.import_module("benchmarks.gpu.__main__").main(line.split())


def rows(path: Path) -> list[dict]:
    return json.loads(path.read_text())["rows"]


def contents(folder: Path) -> dict[str, bytes]:
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


def test_all_three_need_no_tyro_and_no_installed_package(made):
    lines = made[1].splitlines()
    assert Path(lines[-1]) == ROOT / "sglpr_jax" / "__init__.py"
    assert sum("finished" in line for line in lines) == 3
    results = [path for path in (made[0] / "build/gpu").rglob("*") if path.is_file()]
    names = ["measure.json", "simulate.json", "tiny.json", "tiny/config.json", "tiny/model.safetensors"]
    assert sorted(str(path.relative_to(made[0] / "build/gpu")) for path in results) == names
    assert lines[-2].startswith("build/gpu: 5 files")


def test_simulator_and_images_have_rates(made):
    found = {(row["what"], row.get("batch")): row for row in rows(made[0] / "build/gpu/simulate.json")}
    batched = [("cast", 1), ("cast", 2), ("rasterize", 1), ("rasterize", 2)]
    assert set(found) == {("scan", None), *batched, ("density_bev on the host", None), ("dataset", None)}
    cast, images = found["cast", 2], found["rasterize", 2]
    assert cast["scans_per_second"] == pytest.approx(2 / cast["seconds"])
    assert images["points_per_second"] == pytest.approx(1000 / images["seconds"])
    assert found["scan", None]["scans_per_second"] > 0 and found["dataset", None]["scans"] == 40
    assert len(list((made[0] / "towns/08/labels").glob("*.png"))) == 20


def test_a_training_hands_out_scores_and_half_weights(made):
    folder, results = made[0], made[0] / "build/gpu"
    summary = json.loads((results / "tiny.json").read_text())
    assert (summary["steps_made"], summary["finished"], summary["compute"]) == (4, True, "bfloat16")
    assert [line["step"] for line in summary["metrics"] if "score" in line] == [2, 4]
    assert {"raw", "rotated"} <= set(summary["scores"]) and summary["scores"]["sequence"] == "08"
    whole, half = load(folder / "runs/tiny"), load(results / "tiny")
    assert half.config.compute == "bfloat16"
    for one, other in zip(jax.tree.leaves(whole.weights), jax.tree.leaves(half.weights), strict=True):
        assert (one.astype("float16") == other).all()


def test_presets_are_measured_against_both_peaks(made):
    describe, step = rows(made[0] / "build/gpu/measure.json")
    assert [(row["what"], row["images"]) for row in (describe, step)] == [("describe", 1), ("step", 8)]
    for row in (describe, step):
        assert row["flop_per_second"] == pytest.approx(row["flop"] / row["seconds"])
        assert row["share_of_nominal"] == pytest.approx(row["flop_per_second"] / 989e12)
        low, high = row["share_of_peak_spread"]
        assert 0 < low <= row["share_of_peak"] <= high
    assert step["flop"] > 8 * 2 * describe["flop"]  # forward and backward
    assert 0 < describe["program_bytes"] < step["program_bytes"]


def test_a_dataset_is_completed_to_the_same_bytes(begun, stop_after):
    whole = contents(begun / "towns")
    shutil.rmtree(begun / "towns")
    table = begun / "build/gpu/simulate.json"
    measured = rows(table)
    stop_after(10 + 6)  # of the 6 rates there are already, too, it is asked whether to stop
    run(SIMULATE)
    first = rows(table)[-1]
    assert rows(table)[:-1] == measured and not first["finished"] and 0 < first["scans"] < 20
    kept = {path: path.stat().st_mtime_ns for path in (begun / "towns").rglob("*.png")}
    stop_after(None)
    run(SIMULATE)
    last = rows(table)[-1]
    assert last["finished"] and first["scans"] + last["scans"] == 40
    assert contents(begun / "towns") == whole and all(path.stat().st_mtime_ns == kept[path] for path in kept)
    run(SIMULATE)
    assert rows(table)[-1] == last


def test_a_training_goes_on_to_the_same_weights(begun, stop_after, monkeypatch, capsys):
    weights = contents(begun / "build/gpu/tiny")
    for folder in ("runs", "build", "packs"):
        shutil.rmtree(begun / folder)
    stop_after(1)
    run(TRAIN)
    assert "packed in packs" in capsys.readouterr().out and not (begun / "runs").exists()
    stop_after(20 + 3)  # 20 scans are packed before the first step
    run(TRAIN)
    summary = json.loads((begun / "build/gpu/tiny.json").read_text())
    assert (summary["steps_made"], summary["finished"]) == (3, False) and summary["scores"]["raw"]
    assert "goes on" in capsys.readouterr().out
    stop_after(None)
    run(TRAIN)
    assert contents(begun / "build/gpu/tiny") == weights
    finished = json.loads((begun / "build/gpu/tiny.json").read_text())
    assert finished["steps_made"] == 4 and finished["finished"]
    monkeypatch.delattr("benchmarks.gpu.gpu_train.final_test")  # what is tested is not tested again
    monkeypatch.setattr("benchmarks.gpu.small_results.MOST_BYTES", 10**5)
    run(TRAIN)
    again = json.loads((begun / "build/gpu/tiny.json").read_text())
    assert "in the run's folder alone" in again.pop("weights")
    assert again == {name: value for name, value in finished.items() if name != "weights"}


def test_rows_that_are_there_are_not_measured_again(begun, stop_after, monkeypatch):
    table = begun / "build/gpu/measure.json"
    table.unlink()
    stop_after(2)
    run(MEASURE)
    (first,) = rows(table)
    stop_after(None)
    run(MEASURE)
    both = rows(table)
    assert both[0] == first and both[1]["what"] == "step"
    monkeypatch.delattr("benchmarks.gpu.model_rates.rates_in_turn")
    run(MEASURE)
    assert rows(table) == both


def test_time_is_over_when_it_is():
    time_limit = importlib.import_module("benchmarks.gpu.__main__").time_limit
    assert time_limit(0)() and not time_limit(1)()


def test_the_commands_of_the_page_are_known():
    page = (ROOT / "docs/guides/gpu.md").read_text()
    shown = re.findall(r"^(?:\w+=\S+ )?python -m benchmarks\.gpu (.*?)(?:\s+#.*)?$", page, re.MULTILINE)
    asked = [
        importlib.import_module("benchmarks.gpu.__main__").parser().parse_args(shlex.split(line)) for line in shown
    ]
    assert {each.work.__name__ for each in asked} == {"simulate", "train", "measure"}


def test_what_a_device_refuses_is_a_row():
    rates = importlib.import_module("benchmarks.gpu.model_rates")

    def refused():
        raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: out of memory")

    timing = rates.Timing(repeats=1, calls=1, size=8, products=1, peak_tflops=1.0)
    assert rates.measured(refused, "float32", timing) == {"error": "RESOURCE_EXHAUSTED: out of memory"}


def test_results_that_are_too_many_or_too_large_are_said(tmp_path, monkeypatch):
    small = importlib.import_module("benchmarks.gpu.small_results")
    for i in range(8):
        (tmp_path / f"{i}.json").write_text("{}")
    assert "expected" not in small.told(tmp_path)
    (tmp_path / "9.json").write_text("{}")
    assert "9 files" in small.told(tmp_path) and "expected at most 8 files" in small.told(tmp_path)
    monkeypatch.setattr(small, "MOST_BYTES", 1)
    assert "9.json" in small.told(tmp_path)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("train --data nowhere --preset tiny.py --out run", "nowhere"),
        ("train --data towns --preset no-such --out run", "no preset 'no-such'"),
        ("train --data towns --preset tiny.py --out runs/tiny --compute float32", "found others: config.model.compute"),
        (MEASURE.replace("tiny.py", "no-such"), "no preset 'no-such'"),
        (SIMULATE.replace("00 08", "77"), "77"),
        (f"{SIMULATE} --sensor eye", "expected a sensor among"),
        (f"{SIMULATE} --seed 1", "another simulated dataset"),
    ],
)
def test_bad_input_is_one_line(line, message, begun):
    if "--seed" in line:
        shutil.rmtree(begun / "towns/08")
    with pytest.raises(SystemExit) as ended:
        run(line)
    assert str(ended.value).startswith("error: ") and message in str(ended.value)
    assert "\n" not in str(ended.value)


def test_a_damaged_table_and_numbers_that_cannot_be_are_refused(begun, capsys):
    (begun / "build/gpu/measure.json").write_text('{"rows": 3}')
    with pytest.raises(SystemExit, match=r"measure\.json: expected a table with rows"):
        run(MEASURE)
    for flags in ("--minutes 0", "--minutes soon", "--repeats -1"):
        with pytest.raises(SystemExit):
            run(f"{MEASURE} {flags}")
        assert f"found {flags.split()[1]}" in capsys.readouterr().err
