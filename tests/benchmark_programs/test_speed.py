"""What benchmarks measure in seconds: the ways are compared, their results equal, and the shares add up."""

import importlib
import importlib.util
import json
import sys
from collections.abc import Callable

import numpy as np
import pytest

from sglpr_jax.sim.dataset import simulate

from .programs import SENSOR, TINY, printed, table

pytestmark = pytest.mark.slow


def test_rasterize_agrees_with_numpy_and_prints_ratios():
    options = ("--points", "2000", "--size", "32", "--repeats", "2", "--calls", "1", "--threads", "1")
    output = printed("speed.rasterize", *options)
    assert "rasterize: largest difference 0" in output
    assert "rasterize_labels: largest difference 0" in output
    assert "JAX / numpy" in output
    assert "--points 2000" in output


def test_different_results_are_not_timed(monkeypatch):
    ratio = importlib.import_module("benchmarks.speed.ratio")
    ratio.check_equal("same", np.array([1.0, 2.0]), np.array([1.0, 2.0]), tolerance=0)
    with pytest.raises(SystemExit, match="do not agree"):
        ratio.check_equal("unlike", np.array([1.0, 2.0]), np.array([1.0, 2.1]), tolerance=1e-3)


def _fills(megabytes: int) -> Callable[[], float]:
    return lambda: np.ones(megabytes * 125_000).sum()


def test_the_peak_of_a_process_is_that_of_its_last_runs():
    contender = importlib.import_module("benchmarks.speed.ratio").Contender("numpy", _fills, 400, threads=1)
    before = contender.peak_mb()
    contender.run()
    assert 300 < contender.peak_mb() - before < 500
    contender.forget_peak()
    assert contender.peak_mb() < before + 100


def test_allocator_prints_ratios_and_what_each_setting_costs():
    options = ("--preset", TINY, "--repeats", 2, "--steps", 1, "--points", 50, "--threads", 1)
    output = printed("speed.allocator", *options)
    assert "as it comes: " in output and "kept: " in output and output.count("page faults a step") == 2
    assert "Below 1 kept is faster" in output


def test_simulate_prints_its_rate_and_where_the_time_goes():
    output = printed("speed.simulate", "--sensor", "vlp16", "--azimuth-steps", "90", "--scans", "2", "--repeats", "1")
    for words in ("cull", "cast", "returns", "copy", "2 thread(s):", "scans per second", "Shapes in range", "vlp16"):
        assert words in output
    shares = [int(line.split("%")[0].split()[-1]) for line in output.splitlines() if "%" in line]
    assert len(shares) == 4 and 97 <= sum(shares) <= 103


def test_batches_of_packs_are_timed_against_files(tmp_path):
    simulate(tmp_path / "town", routes=("00",), scans=40, sensor=SENSOR)
    folders = ("--data", tmp_path / "town", "--cache", tmp_path / "cache")
    output = printed("speed.read_batches", *folders, "--preset", TINY, "--count", 1, "--repeats", 2, "--cold")
    assert "40 scans of" in output and "pack / files" in output
    assert len(list((tmp_path / "cache").iterdir())) == 1


def test_throughput_is_a_share_of_the_peak(tmp_path):
    out = tmp_path / "benchmarks.speed.throughput.json"
    output = printed("speed.throughput", "--preset", TINY, "--size", 64, "--repeats", 2, "--steps", 1, "--out", out)
    assert "tuples/s" in output and "GFLOP/tuple" in output
    (row,) = json.loads(out.read_text())["rows"]
    assert (row["preset"], row["compute"], row["tuples"], row["images"]) == ("tiny", "float32", 2, 8)
    assert row["images_per_second"] == pytest.approx(4 * row["tuples_per_second"])
    assert row["flop_per_second"] == pytest.approx(row["flop_per_tuple"] * row["tuples_per_second"])
    low, high = row["share_of_peak_spread"]
    assert 0 < low <= row["share_of_peak"] <= high


def test_segmented_steps_are_timed_against_one_without_labels(tmp_path):
    out = tmp_path / "segmented.json"
    options = ("--preset", TINY, "--every", 2, 1, "--detail", 0, "--repeats", 2, "--out", out)
    shown = table(printed("speed.segmented_step", *options))
    rows = json.loads(out.read_text())["rows"]
    assert [(row["preset"], row["every"], row["detail"]) for row in rows] == [("tiny", 2, 0), ("tiny", 1, 0)]
    assert [row[1:3] for row in shown] == [["2", "0"], ["1", "0"]]
    for row in rows:
        low, high = row["spread"]
        assert 0 < low <= row["ratio"] <= high


def test_all_pairs_are_timed_distance_by_distance(tmp_path):
    simulate(tmp_path, routes=("00",), scans=4, sensor=SENSOR)
    options = ("--methods", "scan-context", "random", "--frames", 100, "--seconds", 0)
    rows = table(printed("speed.all_pairs", "--data", tmp_path, *options))
    assert [row[:3] for row in rows] == [["scan-context", "scan-context", "64"], ["random", "l2", "64"]]
    for row in rows:
        per_pair, whole = float(row[4]), float(row[5].split()[0])
        assert per_pair > 0 and whole == pytest.approx(per_pair * 1e-6 * 100**2, abs=0.06)


def test_the_time_of_a_step_is_told_by_parts():
    rows = table(printed("speed.profile_step", "--preset", TINY, "--steps", 1))
    parts = {row[0] for row in rows}
    assert {"place_head/cbam", "images, losses, optimiser", "segmentation_head"} <= parts
    assert any(part.startswith("backbone/") for part in parts)
    forward = sum(float(row[1]) for row in rows)
    backward = sum(float(row[3]) for row in rows)
    assert forward > 0 and backward > 0
    assert sum(float(row[5][:-1]) for row in rows) == pytest.approx(100, abs=0.1 * len(rows))


def test_the_way_from_a_file_to_its_descriptor_is_timed():
    output = printed("speed.embed", "--weights", "circular", "--scans", "65", "--repeats", "1", "--azimuth-steps", "90")
    assert "circular: " in output and "scans/s" in output
    assert all(f"{part} " in output for part in ("reading", "image", "network"))


def test_the_start_of_commands_is_timed():
    options = ("--commands", "embed", "--presets", "tiny", "--weights", "circular", "--repeats", 1)
    rows = table(printed("speed.start_up", *options))
    assert [row[0] for row in rows] == [
        "load and describe one image, circular, cold",
        "embed one scan, circular, cold",
        "embed --help",
        "init, tiny",
        "import jax",
        "load, circular",
        "load and describe one image, circular, warm",
        "embed one scan, circular, warm",
    ]
    assert min(float(row[3]) for row in rows) > 0


def test_index_is_timed_beside_others():
    output = printed("speed.index", "--rows", "3000", "--width", "16", "--repeats", "2")
    assert "Index: " in output and "MB for 3,000 places" in output
    assert "FleetIndex: " in output and "100.00% of the answers are those of Index" in output
    assert "Below 1 Index is faster" in output
    if importlib.util.find_spec("faiss") is None:
        assert "faiss: not installed (faiss: pip install -r benchmarks/speed/index.txt" in output


@pytest.mark.parametrize("name", ["describe", "train_step"])
def test_missing_torch_is_one_clear_error(name, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(SystemExit, match=r"PyTorch.*pip install 'sglpr-jax\[torch\]'"):
        importlib.import_module(f"benchmarks.torch_peer.{name}").main()


def test_a_missing_compiler_is_one_clear_error(monkeypatch):
    beside_torch = importlib.import_module("benchmarks.torch_peer.beside_torch")
    monkeypatch.setattr(beside_torch, "require_torch", lambda: None)
    monkeypatch.setenv("CXX", "no-such-compiler")
    with pytest.raises(SystemExit, match=r"^--compiled: .* C\+\+ compiler, but there is no no-such-compiler$"):
        beside_torch.prepare_to_compare(1, compiled=True)


def test_growth_tells_the_exponent_of_everything():
    growth = importlib.import_module("benchmarks.speed.growth")
    assert growth.exponent([1, 2, 4], [3.0, 12.0, 48.0]) == pytest.approx(2)
    rows = table(printed("speed.growth", "--preset", "tiny", "--sectors", 0, "--largest", 2, "--repeats", 1))
    assert len(rows) == 5 and rows[0][:3] == ["points of a scan, point counts", "15,000", "60,000"]
    assert all(np.isfinite(float(row[5])) for row in rows)


@pytest.mark.parametrize("odometry", [(), ("--odometry",)])
def test_a_long_drive_tells_memory_and_time_a_frame(odometry):
    rows = table(printed("speed.long_drive", "--frames", 40, 340, "--lap", 305, "--window", 20, *odometry))
    assert [row[0] for row in rows] == ["40", "340"]
    assert all(int(row[2].replace(",", "")) > 1000 and float(row[3]) > 0 for row in rows)
    assert int(rows[0][4]) == 0 < int(rows[1][4])


def test_bytes_are_counted_once_and_not_those_of_code():
    held_bytes = importlib.import_module("benchmarks.speed.long_drive").held_bytes
    array = np.zeros(1000)
    assert 8000 < held_bytes([array, array[1:], array[2:], np.zeros]) < 9000


def test_the_latency_of_a_running_node_is_measured():
    options = ("--rates", "5", "--seconds", "2", "--warm-s", "1", "--scans", "10", "--weights", "circular")
    head, _, row = printed("speed.live", *options).strip().splitlines()
    found = dict(zip(head.split("|"), row.split("|"), strict=True))
    assert float(found[" taken "]) == float(found[" published "]) == 15 and float(found[" dropped "]) == 0
    assert 0 < float(found[" frame 50 % [ms] "]) <= float(found[" frame 99 % [ms] "])
