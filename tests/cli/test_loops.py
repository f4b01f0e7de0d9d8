import json

import numpy as np
import pytest

from sglpr_jax.cli.loops import LoopsCommand, _next_step
from sglpr_jax.cli.recording import CloudOptions
from sglpr_jax.data.formats.pose_files import read_kitti, read_tum
from sglpr_jax.loops import search
from sglpr_jax.loops.closure import LoopClosure, RejectedClosure
from sglpr_jax.loops.config import DetectorConfig
from sglpr_jax.odometry.drift_check import OdometryCheck
from sglpr_jax.odometry.drift_model import DriftModel
from sglpr_jax.pose_graph.files import read_g2o, read_loops_jsonl, write_tum

from .conftest import SCANS, WALK

FILES = {"loops.g2o", "loops.jsonl", "loops.csv", "rejected.jsonl", "index.html", "command.json"}
TRAJECTORIES = {f"trajectory{kind}" for kind in (".tum", ".kitti", "-optimized.tum", "-optimized.kitti")}


@pytest.fixture(scope="module")
def odometry(town) -> np.ndarray:
    """True poses of the sensor of 08."""
    return read_kitti(town / "sequences/08/poses.txt")


@pytest.mark.slow
def test_the_next_step_keeps_the_scale_and_quotes_paths(tmp_path):
    output = CloudOptions(cloud=tmp_path / "c.ply")
    command = LoopsCommand((tmp_path / "my scans",), odometry="auto", optimize=True, scale=4, output=output)
    said = _next_step(command)
    assert said.startswith(f"bin/map '{tmp_path}/my scans' --poses ") and " --scale 4 makes a map" in said


def test_bin_loops_writes_the_files_and_page_of_the_library(command, walk, tmp_path, monkeypatch):
    found, find_loops = [], search.find_loops
    monkeypatch.setattr(
        search, "find_loops", lambda *given, **options: found.append(find_loops(*given, **options)) or found[0]
    )
    out, (odometry, _) = tmp_path / "found", read_tum(walk / "poses.tum")
    times = 1.6e9 + np.arange(2.0 * WALK)
    write_tum(tmp_path / "odometry.tum", odometry, times)
    options = ("--odometry", tmp_path / "odometry.tum", "--out", out, "--optimize")
    drift = ("--drift-percent", "2", "--drift-deg-per-100m", "1", "--min-probability", "0.5")
    ended = command("loops", walk / "scans", *options, *drift)
    assert ended.status == 0 and "times: from odometry.tum" in ended.error and "warning" not in ended.error
    assert {path.name for path in out.iterdir()} == FILES | TRAJECTORIES
    assert found[0].config == DetectorConfig(min_probability=0.5, drift=DriftModel(0.02, 0.01))
    loops = read_loops_jsonl(out / "loops.jsonl")
    assert [(loop.query, loop.match) for loop in loops] == [(loop.query, loop.match) for loop in found[0].loops]
    assert len(loops) >= 5 and ended.out.splitlines()[0] == str(found[0])
    for line in (out / "loops.jsonl").read_text().splitlines():
        value = json.loads(line)
        assert value["query_id"] == f"{value['query']:06d}" and value["probability"] >= 0.5
    graph = read_g2o(out / "loops.g2o")
    assert len(graph.poses) == 2 * WALK and len(graph.edges) == 2 * WALK - 1 + len(loops)
    for name in ("trajectory.tum", "trajectory-optimized.tum"):
        poses, clock = read_tum(out / name)
        np.testing.assert_allclose(poses, odometry, atol=1e-5 if name == "trajectory.tum" else 0.5)
        np.testing.assert_allclose(clock, times, atol=1e-5)
    assert "trajectory corrected by " in ended.out and f" of {len(loops)} loops" in ended.out
    page = (out / "index.html").read_text()
    assert "Trajectory corrected by " in page and "<h2>Trajectory</h2>" in page
    assert page.count("data:image/png;base64,") >= 2


@pytest.mark.slow
def test_loops_are_written_if_the_scans_contradict_the_odometry(command, town, odometry, tmp_path, monkeypatch):
    monkeypatch.setattr(OdometryCheck, "errors", (0.5, 0.02))
    write_tum(tmp_path / "odometry.tum", odometry, np.arange(float(SCANS)))
    out = tmp_path / "found"
    options = ("--odometry", tmp_path / "odometry.tum", "--odometry-format", "tum", "--optimize", "--out", out)
    ended = command("loops", town, "--seq", "08", *options)
    assert ended.status == 0 and "differs by 50 % of the travelled distance" in ended.error, ended.error
    assert "trajectory not corrected: the odometry of 08 contradicts the scans and is not used" in ended.out
    assert {path.name for path in out.iterdir()} == FILES


@pytest.mark.slow
def test_ctrl_c_writes_the_loops_found_until_then_without_odometry(command, town, tmp_path, monkeypatch):
    find_loops = search.find_loops

    def stopped(recording, params, *, should_stop, on_progress, **options):
        done = []

        def stop():
            if len(done) >= 5:
                should_stop.signal = 2
            return should_stop()

        return find_loops(recording, params, **options, should_stop=stop, on_progress=done.append)

    monkeypatch.setattr(search, "find_loops", stopped)
    ended = command("loops", town, "--seq", "08", "--out", tmp_path / "found")
    assert ended.status == 130
    assert ended.out.startswith("0 loops in 5 of 40 frames of 08")
    assert {path.name for path in (tmp_path / "found").iterdir()} == FILES | {"unfinished"}
    assert "run the same command again to continue" in ended.error


@pytest.mark.slow
def test_rejected_pairs_and_missing_loops_are_explained(command, town, tmp_path, monkeypatch):
    """And a degenerate loop is kept, or rejected with `--degenerate drop`."""
    unsure = LoopClosure(35, 1, np.eye(4), np.diag([4.0, 0.01, 1, 1, 1, 1]), 0.995)

    def some(recordings, params, **options):
        return search.LoopSearchResult(
            (search.Session(recordings[0], SCANS, keyframes=SCANS),), (unsure,), (RejectedClosure(unsure, "repeats"),)
        )

    monkeypatch.setattr(search, "find_loops", some)
    run = ("loops", town, "--seq", "08", "--out", tmp_path / "found")
    kept = command(*run)
    repeats = "rejected, repeats (1): Another place, or another pose, fits about as well."
    assert kept.status == 0, kept.error
    assert kept.out.splitlines()[:2] == [
        "1 loops (1 degenerate) in 40 of 40 frames of 08, 1 rejected (repeats: 1)",
        repeats,
    ]
    assert len(read_g2o(tmp_path / "found" / "loops.g2o").edges) == 1
    lines = command(*run, "--degenerate", "drop").out.splitlines()
    assert lines[0] == "0 loops in 40 of 40 frames of 08, 2 rejected (repeats: 1, degenerate: 1)"
    assert "2 pairs were rejected. For 1 of them: Another place, or another pose, fits about as well." in lines
    assert repeats in lines and any(line.startswith("rejected, degenerate (1): The position") for line in lines)
    assert read_g2o(tmp_path / "found" / "loops.g2o").edges == []
    rows = map(json.loads, (tmp_path / "found" / "rejected.jsonl").read_text().splitlines())
    assert [row["reason"] for row in rows] == ["repeats", "degenerate"]


@pytest.mark.parametrize(("layout", "said"), [("town", None), ("images", "because 06 has ready-made images")])
def test_scans_are_registered_if_possible(command, town, images, tmp_path, monkeypatch, layout, said):
    asked = []

    def searched(recordings, params, *, registered, **options):
        asked.append(registered)
        return search.LoopSearchResult((search.Session(recordings[0], len(recordings[0])),))

    monkeypatch.setattr(search, "find_loops", searched)
    source = (town, "--seq", "08") if layout == "town" else (images, "--seq", "06")
    ended = command("loops", *source, "--out", tmp_path / "found")
    assert ended.status == 0 and asked == [None], ended.error
    lines = [line for line in ended.error.splitlines() if "not registered" in line]
    assert len(lines) == (said is not None) and all(line.endswith(said) for line in lines)
