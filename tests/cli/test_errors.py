"""Wrong input of each command is one line on stderr, and nothing is written."""

import shlex
import shutil

import pytest

from sglpr_jax.cli.__main__ import COMMANDS
from sglpr_jax.files import exclusive_lock

from .conftest import assert_one_line_error, run_command

EMBED = "embed --out {out}.npz --method polar-fft --data"
LOOPS = "loops {town} --seq 08 --out {out}"
MAP = "map {walk}/scans --poses {walk}/poses.tum --out"
TRAIN = "train --preset {tiny} --out {out} --seq 06 --data {images}"
ERRORS = {
    "convert {root}/no.safetensors --preset {tiny} --out {out}": "expected a checkpoint, found no file",
    "demo --scans 3 --out {file}/demo": "cannot be written",
    f"{EMBED} {{town}} --seq 8": "'8', found 00, 05, 08",
    f"{EMBED} {{root}}/none": "no such folder",
    f"{EMBED} {{images}} --seq 06 --method m2dp": "m2dp needs points, found only images in sequence 06",
    f"{EMBED} {{walk}}/scans --submap-m 10": "expected poses with rotations for --submap-m, found none",
    f"{EMBED} {{walk}}/scans --odometry {{walk}}/poses.tum": "expected --submap-m or --deskew with --odometry",
    f"{EMBED} {{town}} --seq 08 --weights sglpr": "expected --method sglpr or one of bin/peers with --weights",
    "embed --data {town} --out {out}": "expected --out to end in .npz or /",
    "evaluate {root}/no.npz": "no.npz: expected a descriptor file, .npy, top-k list or scored pairs, found none",
    "export --weights sglpr-smal --out {out}": "sglpr-smal: expected a folder",
    "export --out {root}": "expected a folder that does not exist yet",
    "live ros:1 --out {out}": "ros:1: expected one of the sources folder, bag, dds, zenoh, found ros",
    "live folder:{root} --out {out} --poses {out}/trajectory.tum": "odometry that this run does not overwrite",
    "live bag:a.mcap --out {out} --sinks json:{out}/loops.jsonl": "a file that this run does not overwrite",
    "live folder:{root} --out {out} --cloud {out}.ply": "expected --odometry-topic or --poses, found neither",
    "live bag:a.mcap --poses a.tum --out {out}": "bag:a.mcap: expected odometry by --odometry-topic, found --poses",
    "live folder:. --odometry-topic /odom --out {out}": "expected odometry by --poses, found --odometry-topic",
    f"{LOOPS} --optimize": "--odometry, found none",
    f"{LOOPS} --odometry {{walk}}/poses.tum --min-probability nan": "--min-probability: expected a finite number",
    f"{LOOPS} --odometry {{root}}/none.tum": "none.tum: expected odometry",
    f"{LOOPS} --odometry {{out}}/loops.g2o": "loops.g2o: expected inputs that this run does not overwrite",
    f"{LOOPS} --odometry {{out}}/trajectory-optimized.tum": "expected inputs that this run does not overwrite",
    "loops {town} --seq 08 --out {file}": "expected a folder to write into, found a file",
    f"{MAP} {{out}}.npz": "expected --out to end in .safetensors",
    f"{MAP} {{out}}.safetensors --add-to {{root}}": "expected an index, found a folder",
    "peers train rinet {images} --out {out}": "rinet needs points, found only images in sequence 00",
    "peers train": "expected bin/peers train METHOD DATA... --out RUN",
    "relocalize scan.bin --map no.safetensors --submap-m 10": "scan.bin: expected --frame with --submap-m",
    "relocalize scan.bin --map no.safetensors --gravity scan": "scan.bin: expected --frame with --gravity",
    "relocalize scan.bin --map no.safetensors --imu-topic /imu": "scan.bin: expected --frame with --imu-topic",
    "reproduce --data {town} --out {out}": "expected tables or figures",
    "reproduce table5 --data {images} --out {out}": "table5 is about semantics",
    "reproduce table1 --data {images} --seq 06 --out {out} --method m2dp polar-fft": "use --method polar-fft",
    "train --seq 06 --data {images} {images} --out {out}": "found '00', as in",
    "reproduce table1 --data {town} --out {out} --method bow": "'bow'",
    "segment --weights segmented --data {images} --out {out}": "segmented: expected a folder",
    "simulate --out {out} --seq 11": "'11'",
    "simulate --out {out} --sessions 2012-1-32": "'2012-1-32'",
    f"{TRAIN} --also {{town}}": "3 of its recordings and 0 tuples",
    f"{TRAIN} --also {{images}}": "--also: expected datasets without the tested recording 06",
    f"{TRAIN} --pseudo-labels {{root}}": "NN/<id>.png",
    f"{TRAIN} --sampling.positive-m 0.001": "as positives, found none",
    f"{TRAIN} --hosts 2": "HOST:PORT",
    f"{TRAIN} --method ssc": "ssc needs points, found only images in sequence 06",
}


def test_every_command_has_an_error():
    assert {line.split()[0] for line in ERRORS} == COMMANDS.keys()


@pytest.mark.parametrize("line", ERRORS)
def test_wrong_input_is_one_line_and_nothing_is_written(line, town, walk, images, preset, tmp_path):
    (tmp_path / "file").touch()
    paths = {"out": tmp_path / "out", "root": tmp_path, "file": tmp_path / "file", "tiny": preset}
    words = shlex.split(line.format(town=town, walk=walk, images=images, **paths))
    assert_one_line_error(run_command(*words), ERRORS[line])
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize(
    ("line", "lock"),
    [("loops {scans} --out {out}", "out/unfinished"), (f"{MAP} {{out}}.safetensors", "out.unfinished")],
)
def test_two_processes_do_not_write_one_result(line, lock, walk, tmp_path):
    with exclusive_lock(tmp_path / lock):
        ended = run_command(*line.format(scans=walk / "scans", walk=walk, out=tmp_path / "out").split())
    assert_one_line_error(ended, "unfinished: expected exclusive use, found another process at work")
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("loops {scans} --out {out} --no-register", "1 scans skipped"),
        ("map {scans} --poses {poses} --spacing-m 0 --out {out}.safetensors", "1 scans skipped"),
    ],
)
def test_bad_scans_are_errors_or_skipped(line, said, walk, tmp_path):
    scans = shutil.copytree(walk / "scans", tmp_path / "scans")
    for path in sorted(scans.iterdir())[8:]:
        path.unlink()
    poses = (walk / "poses.tum").read_text().splitlines(keepends=True)
    (tmp_path / "poses.tum").write_text("".join(poses[:8]))
    (scans / "000003.bin").write_bytes(b"half")
    words = line.format(scans=scans, poses=tmp_path / "poses.tum", out=tmp_path / "out").split()
    assert_one_line_error(run_command(*words), "000003.bin")
    ended = run_command(*words, "--skip-bad")
    assert ended.status == 0, ended.error
    assert said in ended.out and "skipped 000003: " in ended.error
