"""One intact file of each format that the package reads, and the function that reads it."""

import dataclasses
import hashlib
import json
import tempfile
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import safetensors.numpy
from PIL import Image

from sglpr_jax.data.formats.png import read_label_image
from sglpr_jax.data.formats.pose_files import Trajectory, read_times, read_trajectory
from sglpr_jax.data.formats.scan_files import read_labels, read_scan
from sglpr_jax.data.formats.tensors import hash_of
from sglpr_jax.data.packed import open_pack, packed
from sglpr_jax.data.readers import bev_images, open_recording
from sglpr_jax.data.readers.mulran_helipr_boreas_nclt import read_nclt_poses
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scan import Scan
from sglpr_jax.evaluation.inputs import read_input
from sglpr_jax.files import read_json, write_text
from sglpr_jax.frame_log import HEAD, FrameLog
from sglpr_jax.grid import Grid
from sglpr_jax.loops.closure import LoopClosure
from sglpr_jax.maps.place_map import PlaceMap
from sglpr_jax.models.backbone_config import SwinConfig
from sglpr_jax.models.config import HeadConfig, ModelConfig, config_from_dict
from sglpr_jax.models.sglpr import weight_shapes
from sglpr_jax.models.weights_file import CONFIG_FILE, VALUES_HASH, WEIGHTS_FILE, load
from sglpr_jax.odometry.drift_model import DriftModel
from sglpr_jax.pose_graph import files as loop_files
from sglpr_jax.retrieval.descriptor_file import DescriptorFile
from sglpr_jax.retrieval.index import Index
from sglpr_jax.se3 import transform
from sglpr_jax.training.checkpoint import rename_damaged
from sglpr_jax.training.metrics_log import read_metrics
from sglpr_jax.training.mining import DescriptorCache
from tests import bags
from tests.clouds import las, pcd, ply, records_of, stream_of

N = 5
RNG = np.random.default_rng(0)
POSITIONS, TIMES = np.round(RNG.normal(scale=30, size=(N, 3)), 3), np.arange(N) * 0.5
DESCRIPTORS = RNG.normal(size=(N, 4)).astype(np.float32)
POINTS = RNG.normal(scale=9, size=(N, 4)).astype("<f4")
RECORDS = records_of(POINTS[:, :3], i=POINTS[:, 3])
TRAJECTORY = Trajectory(POSITIONS, TIMES, "poses")


class Format(NamedTuple):
    """A file, and how it is read."""

    file: str
    whole: bytes
    read: Callable[[Path], Any]
    beside: Mapping[str, bytes] = {}
    """Files that must lie beside it."""


def written(write: Callable[[Path], Any], name: str) -> bytes:
    """Content of the file that a function writes."""
    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder) / name)
        return (Path(folder) / name).read_bytes()


def text(rows: Iterable[Iterable[float]], separator: str = " ") -> bytes:
    """Rows of numbers, one a line."""
    return "".join(separator.join(f"{value:.17g}" for value in row) + "\n" for row in rows).encode()


def png(pixels: np.ndarray) -> bytes:
    """A PNG image."""
    return stream_of(lambda stream: Image.fromarray(pixels).save(stream, "PNG"))


def bag(kind: str, file: str) -> bytes:
    """A file of a bag with three clouds."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / bags.FILES[kind]
        clouds = [bags.cloud(kind, 100.0 + i, POINTS[:, :3] + i) for i in range(3)]
        bags.write_bag(path, kind, [("/points", bags.CLOUD, 100.0 + i, one) for i, one in enumerate(clouds)])
        return path.joinpath(file).read_bytes() if path.is_dir() else path.read_bytes()


def read_bag(path: Path) -> list[np.ndarray]:
    """All clouds of a bag."""
    recording = open_recording(path, sensor_height=1.73)
    return [recording.points(i) for i in range(len(recording))]


def pack() -> dict[str, bytes]:
    """Files of a pack of five scans."""
    clouds = [np.arange(12.0 * (i + 1), dtype=np.float32).reshape(-1, 3) for i in range(N)]
    with tempfile.TemporaryDirectory() as folder:
        paths = tuple(Path(folder) / f"{i}.bin" for i in range(N))
        for path in paths:
            path.touch()
        read = dict(zip(paths, clouds, strict=True))
        names = tuple(path.stem for path in paths)
        packed(
            Recording("08", names, paths, lambda path, *_: Scan(points=read[path])),
            Path(folder) / "packs",
        )
        return {path.name: path.read_bytes() for path in (Path(folder) / "packs").glob("*/*")}


def read_pack(path: Path) -> list[np.ndarray]:
    """All arrays of the pack that a file belongs to."""
    points = open_pack(path.parent)["points"]
    return [points[i] for i in range(len(points))]


def nuscenes() -> dict[str, bytes]:
    """A scene of three key frames."""
    scans = {f"samples/LIDAR_TOP/{i}.pcd.bin": np.full((3, 5), i, "<f4").tobytes() for i in range(3)}
    keys = {"calibrated_sensor_token": "c", "sample_token": "s", "ego_pose_token": "e"}
    posed = {"rotation": [0.5, 0.5, 0.5, 0.5], "translation": [9.0, 2.0, 0.0]}
    tables = {
        "scene": [{"token": "t", "name": "scene-0061"}],
        "sample": [{"token": "s", "scene_token": "t"}],
        "sample_data": [
            {"token": f"d{i}", **keys, "timestamp": 1532402927000000 + 50000 * i, "filename": file}
            for i, file in enumerate(scans)
        ],
        "ego_pose": [{"token": "e", **posed}],
        "calibrated_sensor": [{"token": "c", **posed}],
    }
    return {f"v1.0-mini/{name}.json": json.dumps(rows).encode() for name, rows in tables.items()} | scans


CONFIG = ModelConfig(
    grid=Grid(resolution_m=3.2, height=16, width=16),
    backbone=SwinConfig(embed_dim=8, depths=(1,), heads=(2,), window=4, drop_path=0.0),
    head=HeadConfig(channels=(8,), kernels=(4,), strides=(4,), cbam_reduction=4, clusters=2, descriptor_size=8),
    categories=0,
)
CONFIG_JSON = json.dumps(dataclasses.asdict(CONFIG), indent=2).encode()
WEIGHTS = {name: RNG.normal(size=leaf.shape).astype(np.float32) for name, leaf in weight_shapes(CONFIG).items()}
IDS = tuple(f"{i:06d}" for i in range(N))
ABOUT = {"sequence": "08", "pose_source": "poses.txt", "config": {"method": "m"}, "weights_hash": "ab"}
DESCRIBED = DescriptorFile(ids=IDS, positions=POSITIONS, times=TIMES, descriptors=DESCRIPTORS, distance="l2", **ABOUT)
POSES = np.stack([transform(x, y, 0.1 * i) for i, (x, y, _) in enumerate(POSITIONS)])
LOOPS = [
    LoopClosure(3, 0, transform(1.0, 0.5, 0.2), np.diag([0.1] * 6), 0.9375),
    LoopClosure(4, 1, transform(-1.0, 0.25, 3.0), np.diag([0.2] * 6), 0.5, 0.75),
]
INDEX = Index.empty(DESCRIPTORS.shape[1], weights_hash="ab")
INDEX.add(DESCRIPTORS, times=TIMES, positions=POSITIONS)
IMAGES = np.arange(N * 16, dtype=np.uint8).reshape(N, 4, 4)
MAP = PlaceMap(INDEX, IMAGES, POSES, np.tile([1.73, 0.0, 0.0, 1.0], (N, 1)), np.full((N, 2), np.nan))
PACK, NUSCENES = pack(), nuscenes()
TWELVE = text(POSES[:, :3].reshape(N, 12))
UTIMES = [[1326652795280148 + 500000 * i, *POSITIONS[i], 0, 0, 0] for i in range(N)]
METRICS = "".join(f'{{"step": {step}, "loss": {step / 8}}}\n' for step in range(1, N + 1)).encode()


LOG_SETTINGS, LOG_RECORDS = {"weights": "ab" * 32}, [RNG.bytes(size) for size in (900, 20, 4000, 300, 900)]


def frame_log(path: Path) -> None:
    """Write a log."""
    with FrameLog(path, LOG_SETTINGS) as log:
        for frame, record in enumerate(LOG_RECORDS):
            log.append(frame, record)


FRAME_LOG = written(frame_log, "frames.log")


def check_log(path: Path) -> None:
    """Read a damaged log. All records outside the damaged bytes must be there, and no others."""
    content = path.read_bytes()
    pairs = list(zip(FRAME_LOG, content, strict=False))
    before = next((at for at, (one, other) in enumerate(pairs) if one != other), len(pairs))
    backwards = list(zip(reversed(FRAME_LOG), reversed(content), strict=False))
    after = next((at for at, (one, other) in enumerate(backwards) if one != other), len(backwards))
    with FrameLog(path, LOG_SETTINGS) as log:
        found = [log.record(frame) for frame in range(log.end)]
    assert len(found) <= len(LOG_RECORDS)
    for frame, record in enumerate(LOG_RECORDS):
        begin = FRAME_LOG.index(record)
        is_whole = begin + len(record) <= before or begin - HEAD.size >= len(FRAME_LOG) - after
        got = found[frame] if frame < len(found) else None
        assert got == record or (got is None and not is_whole), f"frame {frame} of {path.name} is lost or changed"


def training_checkpoint() -> dict[str, bytes]:
    """Files of a checkpoint of a training."""
    about, state = {"loss": 0.5}, safetensors.numpy.save(WEIGHTS)
    sums = {"about.json": json.dumps(about).encode(), "state/data": state}
    content = {"about": about, "sha256": {name: hashlib.sha256(one).hexdigest() for name, one in sums.items()}}
    return {"4/state/data": state, "4/about.json": json.dumps(content).encode()}


def read_list(path: Path) -> Any:
    """A matrix or list of another program."""
    return read_input(path, TRAJECTORY, sequence="08")


def read_checkpoint(path: Path) -> None:
    """Check the only checkpoint of a folder."""
    rename_damaged(next(parent for parent in path.parents if parent.name == "4").parent)


def read_scenes(path: Path) -> Recording:
    """The scene of the tables in a folder."""
    return open_recording(path.parents[1], sensor_height=1.84)


CHECKPOINT = training_checkpoint()
FORMATS = {
    "scan .bin": Format("1.bin", POINTS.tobytes(), read_scan),
    **{
        f"scan .pcd {data}": Format("1.pcd", pcd(RECORDS, data), read_scan)
        for data in ("binary", "ascii", "binary_compressed")
    },
    **{f"scan .ply {order}": Format("1.ply", ply(RECORDS, order), read_scan) for order in ("", "<", ">")},
    "scan .npy": Format("1.npy", stream_of(np.save, POINTS), read_scan),
    "scan .npz": Format("1.npz", stream_of(np.savez, points=POINTS), read_scan),
    "scan .las": Format("1.las", las(POINTS), read_scan),
    "bag .bag": Format("1.bag", bag("ros1", ""), read_bag),
    "bag .mcap": Format("1.mcap", bag("mcap", "drive.mcap"), read_bag),
    "bag .db3": Format("1.db3", bag("ros2", "drive.db3"), read_bag),
    "labels": Format("1.label", np.arange(N, dtype="<u4").tobytes(), lambda path: read_labels(path, points=N)),
    "image": Format("1.png", png(RNG.integers(0, 255, (6, 8)).astype(np.uint8)), bev_images.read_image),
    "label image": Format(
        "1.png", png(np.full((6, 8), 40, np.uint16)), lambda path: read_label_image(path, shape=(8, 6))
    ),
    "KITTI poses": Format("poses.txt", TWELVE, lambda path: read_trajectory(path, format="kitti")),
    "TUM poses": Format("a.tum", text(np.column_stack([TIMES, POSITIONS, [[0, 0, 0, 1]] * N])), read_trajectory),
    "csv poses": Format("a.csv", b"t,x,y,z\n" + text(np.column_stack([TIMES, POSITIONS]), ","), read_trajectory),
    "times": Format("times.txt", text(TIMES[:, None]), read_times),
    "NCLT ground truth": Format("groundtruth_2012-01-15.csv", text(UTIMES, ","), read_nclt_poses),
    **{
        f"nuScenes {Path(name).stem}": Format(name, NUSCENES[name], read_scenes, NUSCENES)
        for name in NUSCENES
        if "json" in name
    },
    **{f"pack {name}": Format(name, PACK[name], read_pack, PACK) for name in PACK},
    "matrix": Format("mine.npy", stream_of(np.save, DESCRIPTORS), read_list),
    "top-k list": Format("top.txt", b"0: 1=0.5 2=0.25\n3: 4=2\n4:\n", read_list),
    "scored pairs": Format("pairs.txt", b"1 0 0.5 1\n2 0 0.25 0\n4 3 2 1\n", read_list),
    "descriptor file": Format("08.npz", written(DESCRIBED.save, "08.npz"), DescriptorFile.load),
    "descriptor cache": Format(
        "3.npz", stream_of(np.savez, places=np.arange(N), descriptors=DESCRIPTORS), DescriptorCache.load
    ),
    "index": Format("a.safetensors", INDEX.to_bytes(), Index.load),
    "map": Format("a.safetensors", written(MAP.save, "a.safetensors"), PlaceMap.load),
    "g2o": Format(
        "a.g2o",
        written(lambda path: loop_files.write_g2o(path, LOOPS, [(np.arange(N), POSES, DriftModel())]), "a.g2o"),
        loop_files.read_g2o,
    ),
    "loops .jsonl": Format(
        "a.jsonl",
        written(lambda path: write_text(path, loop_files.loop_lines(LOOPS)), "a"),
        loop_files.read_loops_jsonl,
    ),
    "configuration": Format(CONFIG_FILE, CONFIG_JSON, lambda path: config_from_dict(read_json(path), source=path)),
    "weights": Format(
        WEIGHTS_FILE,
        safetensors.numpy.save(WEIGHTS, {VALUES_HASH: hash_of(WEIGHTS)}),
        lambda path: load(path.parent),
        {CONFIG_FILE: CONFIG_JSON},
    ),
    "metrics": Format("metrics.jsonl", METRICS, read_metrics),
    "frame log": Format("frames.log", FRAME_LOG, check_log),
    **{
        f"checkpoint {Path(name).name}": Format(name, CHECKPOINT[name], read_checkpoint, CHECKPOINT)
        for name in CHECKPOINT
    },
}
"""All formats by name."""
