"""The benchmarks run for real; those against PyTorch say so where it is not installed."""

import importlib
import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from recordings import of_scans

from sglpr_jax.models.backbones.swin_layers import SwinBlock
from sglpr_jax.retrieval.descriptor_file import DescriptorFile
from sglpr_jax.sim import Sensor, write_dataset
from sglpr_jax.sim.drive import TimedPoses
from sglpr_jax.sim.recording import SimulatedRecording

pytestmark = pytest.mark.slow
BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"
SENSOR = Sensor(elevations_deg=(2.0, -2.0, -8.0, -16.0), azimuth_steps=90)
PRESET = """
from sglpr_jax.bev import Grid
from sglpr_jax.data.sampling.tuples import TupleConfig
from sglpr_jax.models.backbones.swin import SwinConfig
from sglpr_jax.models.config import HeadConfig, ModelConfig
from sglpr_jax.training.config import TrainConfig

HEAD = HeadConfig(channels=(16,), kernels=(4,), strides=(4,), cbam_reduction=4, clusters=4)
SWIN = SwinConfig(embed_dim=8, depths=(1,), heads=(2,), window=4)
MODEL = ModelConfig(grid=Grid(3.2, 16, 16), backbone=SWIN, head=HEAD)
SAMPLING = TupleConfig(negatives=2, positive_m=16.0)
CONFIG = TrainConfig(model=MODEL, sampling=SAMPLING, tuples=2, chunk=4, max_points=50)
"""


def printed(benchmark: str, *options: str) -> str:
    command = (sys.executable, BENCHMARKS / benchmark, *options)
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_rasterize_agrees_with_numpy_and_prints_ratios():
    options = ("--points", "2000", "--size", "32", "--repeats", "2", "--calls", "1", "--threads", "1")
    output = printed("rasterize.py", *options)
    assert "rasterize: largest difference 0" in output
    assert "rasterize_labels: largest difference 0" in output
    assert "JAX / numpy" in output
    assert "--points 2000" in output


def test_allocator_prints_ratios_and_what_each_setting_costs(tmp_path):
    (tmp_path / "preset.py").write_text(PRESET)
    options = ("--preset", str(tmp_path / "preset.py"), "--repeats", "2", "--steps", "1", "--points", "50")
    output = printed("allocator.py", *options, "--threads", "1")
    assert "as it comes: " in output and "kept: " in output and output.count("page faults a step") == 2
    assert "Below 1 kept is faster" in output


def test_simulate_prints_its_rate_and_where_the_time_goes():
    output = printed("simulate.py", "--sensor", "vlp16", "--azimuth-steps", "90", "--scans", "2", "--repeats", "1")
    for words in ("cull", "cast", "returns", "copy", "2 thread(s):", "scans per second", "Shapes in range", "vlp16"):
        assert words in output
    shares = [int(line.split("%")[0].split()[-1]) for line in output.splitlines() if "%" in line]
    assert len(shares) == 4 and 97 <= sum(shares) <= 103


def test_baselines_are_scored_raw_and_rotated(tmp_path):
    write_dataset(tmp_path, names=("00",), scans=60, sensor=SENSOR)
    output = printed("baselines.py", "--data", str(tmp_path), "--methods", "scan-context", "random")
    assert "60 scans" in output and "revisits" in output
    cells = [[cell.strip() for cell in line.split("│")[1:-1]] for line in output.splitlines() if "│" in line]
    scores = {row[0]: [float(cell) for cell in row[4:8]] for row in cells}
    assert list(scores) == ["scan-context", "random"]
    assert min(scores["scan-context"]) > max(scores["random"])


def test_batches_of_packs_are_timed_against_files(tmp_path):
    write_dataset(tmp_path / "town", names=("00",), scans=40, sensor=SENSOR)
    (tmp_path / "own.py").write_text(PRESET)
    folders = ("--data", tmp_path / "town", "--cache", tmp_path / "cache", "--preset", tmp_path / "own.py")
    output = printed("read_batches.py", *map(str, folders), "--count", "1", "--repeats", "2", "--cold")
    assert "40 scans of" in output and "pack / files" in output
    assert len(list((tmp_path / "cache").iterdir())) == 1


def test_throughput_is_a_share_of_the_peak(tmp_path):
    preset, out = tmp_path / "own.py", tmp_path / "throughput.json"
    preset.write_text(PRESET)
    options = ("--preset", preset, "--size", "64", "--repeats", "2", "--steps", "1", "--out", out)
    output = printed("throughput.py", *map(str, options))
    assert "tuples/s" in output and "GFLOP/tuple" in output
    (row,) = json.loads(out.read_text())["rows"]
    assert (row["preset"], row["compute"], row["tuples"], row["images"]) == ("own", "float32", 2, 8)
    assert row["images_per_second"] == pytest.approx(4 * row["tuples_per_second"])
    assert row["flop_per_second"] == pytest.approx(row["flop_per_tuple"] * row["tuples_per_second"])
    low, high = row["share_of_peak_spread"]
    assert 0 < low <= row["share_of_peak"] <= high


SMALL = ("--scans", "100", "--azimuth-steps", "200", "--towns", "08:3")


def test_the_movement_of_descriptors_under_rotations_is_measured(tmp_path):
    write_dataset(tmp_path, names=("08",), scans=40, sensor=SENSOR, layout="images")
    options = ("--scans", "2", "--step-deg", "120", "--among", "20")
    output = printed("rotation.py", "--data", str(tmp_path), "--weights", "sglpr", "rings", *options)
    assert [line.split(":")[0] for line in output.splitlines()][-2:] == ["sglpr", "rings"]
    assert "4 rotations of 2 scans: moved by 0." in output


def test_the_way_from_a_file_to_its_descriptor_is_timed():
    output = printed("embed.py", "--weights", "rings", "--scans", "65", "--repeats", "1", "--azimuth-steps", "90")
    assert "rings: " in output and "scans/s" in output
    assert all(f"{part} " in output for part in ("reading", "image", "network"))


def test_two_ways_of_training_are_compared_seed_by_seed(tmp_path):
    rng = np.random.default_rng(0)
    places = np.repeat(rng.normal(size=(1, 120, 16)), 2, axis=0).reshape(240, 16)  # every place twice
    positions = np.tile(np.stack([np.arange(120) * 10.0, np.zeros(120), np.zeros(120)], axis=1), (2, 1))

    def written(name: str, noise: float) -> str:
        descriptors = (places + noise * rng.normal(size=places.shape)).astype(np.float32)
        frames = {"sequence": "06", "ids": tuple(map(str, range(240))), "positions": positions, "pose_source": "true"}
        times = np.arange(240) * 1.0
        DescriptorFile(**frames, times=times, descriptors=descriptors, config={}, weights_hash="").save(tmp_path / name)
        return str(tmp_path / name)

    good, bad = ([written(f"{noise}-{seed}.npz", noise) for seed in (1, 2)] for noise in (0.05, 2.0))
    output = printed("paired.py", "--ours", *good, "--others", *bad)
    (row,) = [line for line in output.splitlines() if "top1-f1max" in line]
    ours, others, difference, each, interval = (cell.strip() for cell in row.split("│")[2:-1])
    assert float(ours) == 1 and 0 < float(others) < 0.9
    assert float(difference) == pytest.approx(float(ours) - float(others), abs=2e-3)
    assert np.mean([float(one) for one in each.split()]) == pytest.approx(float(difference), abs=2e-3)
    low, high = map(float, interval.split(" to "))
    assert 0 < low < float(difference) < high


def test_the_time_of_a_step_is_told_by_parts(tmp_path):
    (tmp_path / "own.py").write_text(PRESET)
    output = printed("profile_step.py", "--preset", str(tmp_path / "own.py"), "--steps", "1")
    rows = [[cell.strip() for cell in line.split("│")[1:-1]] for line in output.splitlines() if line.startswith("│")]
    parts = {row[0] for row in rows}
    assert {"place_head/cbam", "images, losses, optimiser", "segmentation_head"} <= parts
    assert any(part.startswith("backbone/") for part in parts)
    forward = sum(float(row[1]) for row in rows)
    backward = sum(float(row[3]) for row in rows)
    assert forward > 0 and backward > 0
    assert sum(float(row[5][:-1]) for row in rows) == pytest.approx(100, abs=0.1 * len(rows))


def test_loops_are_scored_on_simulated_drives():
    output = printed("loops.py", "simulated", *SMALL, "--optimized")
    assert "town 08:3: 100 frames" in output and "kept of the whole drive" in output and "recall of" in output
    assert "trajectory: off by" in output and "pairs at 0.99 or more" in output


def test_loops_are_scored_on_images(tmp_path):
    write_dataset(tmp_path, names=("08",), scans=330, sensor=SENSOR, layout="images")
    output = printed("loops.py", "images", "--data", str(tmp_path), "--seqs", "08", "--odometry")
    assert "nearest descriptor: top-1 F1max" in output and "most probable of three: top-1 F1max" in output


def test_the_parts_of_a_loop_are_timed():
    output = printed("loops.py", "speed", "--frames", "300", "--repeats", "2", "--azimuth-steps", "90")
    assert [line.split(":")[0] for line in output.splitlines()][-4:] == [
        "image and descriptor",
        "query",
        "verification",
        "all of it",
    ]


def test_a_map_opens_however_the_command_was_killed():
    output = printed("kill_map.py", "--kills", "3", "--scans", "30")
    last = output.splitlines()[-1]
    assert last.startswith("3 kills, a run takes") and "damaged" not in last
    assert "absent" in last or "opened" in last


def test_models_of_loops_are_fitted_and_written(tmp_path):
    output = printed("fit_loops.py", *SMALL, "--out", str(tmp_path / "models.json"))
    assert "rings: LoopModel" in output
    found = json.loads((tmp_path / "models.json").read_text())
    assert len(found) == 2 and set(found[""]["weights"]) == {"correlation", "second"}


def table(output: str) -> list[list[str]]:
    """The rows of a printed table."""
    return [[cell.strip() for cell in line.split("│")[1:-1]] for line in output.splitlines() if "│" in line]


def test_many_scans_are_described_and_the_memory_is_told():
    rows = table(printed("load.py", "scans", "--quick"))
    assert [row[0] for row in rows] == [str(50 * i) for i in range(1, 11)]
    assert all(float(row[3]) > 10 for row in rows)


def test_a_command_that_is_killed_leaves_nothing_half_written_and_goes_on(tmp_path):
    printed("load.py", "kills", "--quick", "--commands", "simulate images", "--out", str(tmp_path / "kills.json"))
    (row,) = json.loads((tmp_path / "kills.json").read_text())["rows"]
    assert row["kills"] == 4 and row["files"] > 20
    assert row["half-written"] == row["next run fails"] == row["other bytes"] == 0


def test_two_at_once_and_troubles_with_the_disk_end_well_or_in_one_line(tmp_path):
    for part in ("together", "disk"):
        printed("load.py", part, "--quick", "--commands", "export", "--out", str(tmp_path / f"{part}.json"))
    (row,) = json.loads((tmp_path / "together.json").read_text())["rows"]
    assert row["both end well"] + row["one is refused"] == 4 and row["fail"] == row["other bytes"] == 0
    rows = json.loads((tmp_path / "disk.json").read_text())["rows"]
    assert {row["trouble"]: row["refused in one line"] for row in rows if row["anything else"] == 0} == {
        "full disk": 1,
        "read-only folder": 1,
        "a file vanishes": 0,
        "a file is half there": 0,
    }
    assert not any(row["half-written"] for row in rows)


def test_the_readme_is_followed_line_by_line(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    readme = importlib.import_module("readme_on_bare_machine")
    text = "```bash\nbin/demo    # all of it\nbin/test\n```\n```python\na = 1\n```\ntext\n```python\nprint(a)\n```\n"
    found = readme.steps(text, Path("python"), of_wheel=False)
    assert [(step.line, step.command[-1]) for step in found] == [
        (1, "bin/demo"),
        (1, "bin/test"),
        (5, "a = 1\n"),
        (9, "a = 1\nprint(a)\n"),
    ]
    assert [step.shown for step in readme.steps(text, Path("python"), of_wheel=True)] == [
        "sglpr-demo",
        "Python, 1 lines",
        "Python, 1 lines",
    ]


def flops(function, *shapes: tuple[int, ...]) -> int:
    """What the counter of the benchmarks says of a function of arrays of these shapes."""
    count = importlib.import_module("flops").count_flops
    return count(jax.jit(function).trace(*(jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes)).jaxpr)


@pytest.fixture
def _benchmarks(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))


@pytest.mark.usefixtures("_benchmarks")
def test_products_are_counted_as_by_hand():
    product = 2 * 7 * 3 * 5 * 4
    assert flops(lambda a, b: jnp.einsum("bij,bjk->bik", a, b), (7, 3, 5), (7, 5, 4)) == product
    both = jax.grad(lambda ab: (ab[0] @ ab[1]).sum() + jnp.square(ab[0] @ ab[1]).sum())
    assert flops(lambda a, b: both((a, b)), (7, 3, 5), (7, 5, 4)) == product * 3 + product * 2
    assert flops(lambda a, b: jax.lax.scan(lambda x, _: (x @ b, None), a, length=6)[0], (3, 5), (5, 5)) == 6 * 150
    assert flops(lambda a, b: jax.lax.cond(a.sum() > 0, lambda: a @ b, lambda: a), (5, 5), (5, 5)) == 250
    assert flops(lambda a, b: (a @ b, a + 1)[1], (5, 5), (5, 5)) == 0  # nobody needs it
    with pytest.raises(ValueError, match="number of turns"):
        flops(lambda a, b: jax.lax.while_loop(lambda x: x.sum() > 0, lambda x: x @ b, a), (5, 5), (5, 5))


@pytest.mark.usefixtures("_benchmarks")
@pytest.mark.parametrize("groups", [1, 2])
def test_convolutions_and_their_gradients_are_counted_as_by_hand(groups):
    def convolve(image, kernel):
        dimensions = ("NHWC", "HWIO", "NHWC")
        return jax.lax.conv_general_dilated(
            image, kernel, (2, 2), "VALID", dimension_numbers=dimensions, feature_group_count=groups
        )

    image, kernel = (3, 8, 8, 4), (2, 2, 4 // groups, 6)
    forward = 2 * (3 * 4 * 4 * 6) * (2 * 2 * 4 // groups)
    assert flops(convolve, image, kernel) == forward
    gradient = jax.grad(lambda both: jnp.square(convolve(*both)).sum())
    assert flops(lambda *both: gradient(both), image, kernel) == 3 * forward


@pytest.mark.usefixtures("_benchmarks")
def test_a_swin_block_is_counted_as_in_its_paper():
    """4 h w C^2 + 2 M^2 h w C products for the attention (its equation 2), and 8 h w C^2 for the MLP.

    Not in the paper: the bias table is looked up by a product with one-hot rows, once for all images.
    """
    h, w, c, m, heads = 8, 16, 12, 4, 3
    block = SwinBlock(heads=heads, window=m, shifted=False)
    weights = jax.eval_shape(block.init, jax.random.key(0), jnp.zeros((1, h, w, c)))
    traced = jax.jit(block.apply).trace(weights, jax.ShapeDtypeStruct((5, h, w, c), jnp.float32))
    expected = 2 * 5 * (12 * h * w * c**2 + 2 * m**2 * h * w * c)
    bias = 2 * m**4 * (2 * m - 1) ** 2 * heads
    assert importlib.import_module("flops").count_flops(traced.jaxpr) == expected + bias


@pytest.mark.parametrize("name", ["describe", "train_step"])
def test_missing_torch_is_one_clear_error(name, monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(SystemExit, match=r"PyTorch.*pip install 'sglpr-jax\[torch\]'"):
        importlib.import_module(name).main()


def test_different_results_are_not_timed(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    ratio = importlib.import_module("ratio")
    ratio.check_equal("same", np.array([1.0, 2.0]), np.array([1.0, 2.0]), tolerance=0)
    with pytest.raises(SystemExit, match="do not agree"):
        ratio.check_equal("unlike", np.array([1.0, 2.0]), np.array([1.0, 2.1]), tolerance=1e-3)


def test_mounting():
    options = ("--scans", "24", "--routes", "06", "--sensors", "vlp16", "--heights", "1.0", "--pitches", "10")
    row = printed("mounting.py", *options, "--azimuth-steps", "180").splitlines()[-1]
    cells = [cell.strip() for cell in row.strip("|").split("|")]
    assert cells[:3] == ["vlp16", "1", "10"] and cells[5] == "0 of 24"
    assert float(cells[3]) < 0.1 and float(cells[6]) < 0.1


def test_index_is_timed_beside_others():
    output = printed("index.py", "--rows", "3000", "--width", "16", "--repeats", "2")
    assert "Index: " in output and "MB for 3,000 places" in output
    assert "FleetIndex: " in output and "100.00% of the answers are those of Index" in output
    assert "Below 1 Index is faster" in output
    if importlib.util.find_spec("faiss") is None:
        assert "faiss: not installed (faiss: pip install -r benchmarks/index.txt" in output


def test_closures_of_maps_and_of_scans_are_scored_alike(monkeypatch, capsys):
    """A drive out and back along a line: the way back is revisited, and one closure in each list is wrong."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    monkeypatch.delitem(sys.modules, "loops", raising=False)  # the tests have a package of that name
    closures = importlib.import_module("map_closures")
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
