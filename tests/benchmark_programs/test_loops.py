"""The benchmarks of loops: scored on drives and on images, timed, fitted, and beside the closures of maps."""

import importlib
from pathlib import Path

import numpy as np
import pytest
from recordings import of_scans

import sglpr_jax
from sglpr_jax.loops.detector import LoopDetector
from sglpr_jax.loops.probability import ALL, default_model
from sglpr_jax.sim.dataset import simulate
from sglpr_jax.sim.drive import TimedPoses
from sglpr_jax.sim.recording import SimulatedRecording
from sglpr_jax.sim.repeating import simulate_repeating

from .programs import SENSOR, printed

pytestmark = pytest.mark.slow
CHEAPER = ("--weights", "circular")
SMALL = ("--scans", "100", "--azimuth-steps", "120", "--towns", "08:3")


def test_loops_are_scored_on_simulated_drives():
    output = printed("quality.loops", "simulated", *SMALL, "--optimized")
    assert "town 08:3: 100 frames" in output and "kept of the whole drive" in output and "recall of" in output
    assert "trajectory: off by" in output and "pairs at 0.99 or more" in output


def test_loops_are_scored_on_images(tmp_path):
    simulate(tmp_path, routes=("08",), scans=330, sensor=SENSOR, images=True)
    output = printed("quality.loops", "images", "--data", str(tmp_path), "--seqs", "08", "--odometry", *CHEAPER)
    assert "most probable of three: top-1 F1max" in output and "kept first: top-1 F1max" in output


def test_the_parts_of_a_loop_are_timed():
    options = ("--frames", "100", "--repeats", "1", "--azimuth-steps", "60", *CHEAPER)
    output = printed("quality.loops", "speed", *options)
    assert [line.split(":")[0] for line in output.splitlines()][-9:] == [
        "image and descriptor",
        "query",
        "rotations",
        "coarse comparison",
        "comparison",
        "refinement",
        "other places, coarse",
        "other places",
        "all of it",
    ]


@pytest.fixture(scope="module")
def rendered(tmp_path_factory):
    """A drive through a town that comes back, and one along walls that does not, as the detector keeps them."""
    folder = tmp_path_factory.mktemp("drives")
    options = ("--sceneries", "walls", "town", "--sensors", "vlp16", "--scans", "90", "--azimuth-steps", "200")
    printed("quality.repeating_scans", *options, "--revisits", "same", "--out", str(folder))
    return folder


def test_models_of_loops_are_fitted_and_written(rendered, tmp_path):
    output = printed("quality.fit_loops", str(rendered), "--out", str(tmp_path / "model.json"))
    assert "LoopModel" in output and set(default_model(tmp_path / "model.json").alone.curves) == set(ALL)


def test_loops_are_counted_by_scenery_and_drives_are_searched_once(rendered):
    for options in ((), ("--odometry", "drifting")):
        output = printed("quality.repeating", str(rendered), *options)
        assert "2/2 walls-same-vlp16-1" in output and "recall" in output
        again = printed("quality.repeating", str(rendered), *options, "--sceneries", "walls")
        assert "/2" not in again and "town" not in again and "walls" in again


def test_the_right_place_of_a_revisit_fits_better_than_lookalikes_in_a_town(rendered, tmp_path):
    picture = tmp_path / "missing.png"
    output = printed("quality.missing_evidence", str(rendered), "--sensor", "vlp16", "--out", str(picture))
    _, revisits, compared, best, lookalike, _ = next(
        [cell.strip() for cell in line.strip("│").split("│")] for line in output.splitlines() if "town" in line
    )
    assert int(revisits) > 10 and float(compared) > 0.9 and float(best) > 0.9 and float(lookalike) < 1
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_closures_of_maps_and_of_scans_are_scored_alike(capsys):
    """A drive out and back along a line: the way back is revisited, and one closure in each list is wrong."""
    closures = importlib.import_module("benchmarks.quality.map_closures")
    poses = np.tile(np.eye(4), (80, 1, 1))
    poses[:, 0, 3] = 5.0 * np.r_[np.arange(40), np.arange(40)[::-1]]
    poses[40:, :2, :2] *= -1  # the other way round
    times = np.arange(80.0)
    drive = of_scans({Path(str(i)): np.ones((1, 3)) for i in range(80)}, times=times)
    drive = SimulatedRecording(**vars(drive), poses=TimedPoses(poses, times), render=lambda i: (np.ones((1, 4)), times))
    right = np.linalg.inv(poses[60]) @ poses[0]
    peer = {
        "maps": [[0, 20], [20, 40], [40, 60], [60, 80]],
        "closures": [
            {"source": 0, "target": 3, "target_from_source": right.tolist()},
            {"source": 0, "target": 2, "target_from_source": np.eye(4).tolist()},
        ],
        "seconds": {"odometry": 1.0, "maps and closures": 8.0},
    }
    maps = closures.score_maps(peer, drive)
    assert maps.right.tolist() == [True, False] == (~maps.wrong).tolist() and maps.found == set(range(60, 80))
    assert np.linalg.norm(maps.errors[0, :3, 3]) < 1e-9 and np.linalg.norm(maps.errors[1, :3, 3]) > 100
    assert maps.seconds == 0.1
    pairs = [(70, 9), (75, 40)]
    scans = closures.score(pairs, [np.linalg.inv(poses[9]) @ poses[70], np.eye(4)], drive, 8.0)
    assert scans.right.tolist() == [True, False] == (~scans.wrong).tolist() and scans.found == {70}
    assert np.linalg.norm(scans.errors[0, :3, 3]) < 1e-9
    closures.print_table("a line", {"maps": maps, "scans": scans}, drive)
    table = capsys.readouterr().out
    assert "0.500" in table and "maps" in table


def test_peers_are_counted_where_places_repeat():
    peers = importlib.import_module("benchmarks.quality.repeating_peers")
    recording = simulate_repeating("walls", scans=16, sensor=SENSOR)
    finder = peers.ScanContextFinder(sglpr_jax.load("sglpr"))
    seen = [finder.seen(recording.record(i, labels=False)) for i in (0, 9, 1)]
    assert seen[0].descriptor.shape == (1200,)
    for one in seen:
        finder.index.add(one.descriptor, times=None, positions=None)
    assert finder.stored.nearest(seen[0].descriptor, 2, np.array([False, True, True])).tolist() in ([1, 2], [2, 1])
    detector = LoopDetector(finder.params)
    detector.finder = peers.ScanContextFinder(finder.params)
    found = peers.detected(detector, recording, 20.0)
    assert (found.loops, found.wrong, found.revisits) == (0, 0, 0) and found.seconds > 0
    closure = {"source": 0, "target": 1, "target_from_source": np.eye(4).tolist()}
    peer = {"maps": [[0, 2], [14, 16]], "closures": [closure], "seconds": {"maps and closures": 1.6}}
    assert peers.closed(peer, recording, 20.0) == peers.Counts(1, 1, 0, 0, 0.1)
    assert peers.closed(peer, recording, 1e4).wrong == 0


def test_drives_where_places_repeat_are_rendered_once(tmp_path):
    options = ("--sceneries", "walls", "town", "--revisits", "none", "--sensors", "vlp16", "--scans", "12")
    options = (*options, "--azimuth-steps", "90", "--out", str(tmp_path))
    lines = printed("quality.repeating_scans", *options).splitlines()
    assert [line.split(":")[0] for line in lines] == ["1/2 walls-none-vlp16-1.npz", "2/2 town-none-vlp16-1.npz"]
    with np.load(tmp_path / "walls-none-vlp16-1.npz") as kept:
        assert kept["descriptors"].shape == (12, 256) and kept["images"].dtype == np.uint8
        assert kept["world_from_lidar"].shape == (12, 4, 4) and kept["times"].shape == (12,)
        assert (str(kept["scenery"]), int(kept["seed"]), float(kept["other_m"])) == ("walls", 1, 20.0)
    assert printed("quality.repeating_scans", *options) == ""
