"""Indexes, maps and loops: what searching and pose graphs read. Packs of recordings."""

import json
import tempfile
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import safetensors.numpy

from sglpr_jax.data.formats.scan_files import read_scan
from sglpr_jax.data.packed import open_pack, packed
from sglpr_jax.data.recording import Record, Recording
from sglpr_jax.loops.closure import Loop
from sglpr_jax.maps.place_map import PlaceMap
from sglpr_jax.pose_graph.files import (
    read_g2o,
    read_loops_csv,
    read_loops_jsonl,
    write_g2o,
    write_loops_csv,
    write_loops_jsonl,
)
from sglpr_jax.retrieval.index import Index
from sglpr_jax.se3 import transform

from .damage import BYTES, Damage, Damaged, change_json, change_word, drop_word, safetensors_file, safetensors_parts
from .road import DESCRIPTORS, POSITIONS, TIMES, N, Road, as_whole, plain

POSES = np.stack([transform(x, y, 0.1 * i) for i, (x, y, _) in enumerate(POSITIONS)])
LOOPS = [
    Loop(3, 0, transform(1.0, 0.5, 0.2), np.diag([0.1] * 6), 0.9375),
    Loop(4, 1, transform(-1.0, 0.25, 3.0), np.diag([0.2] * 6), 0.5, 0.75),
]


def written(write: Callable[[Path], Any], name: str) -> bytes:
    """What is written into a file."""
    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder) / name)
        return (Path(folder) / name).read_bytes()


def index() -> Index:
    places = Index.empty(DESCRIPTORS.shape[1], weights_hash="ab")
    places.add(DESCRIPTORS, times=TIMES, positions=POSITIONS)
    return places


def place_map() -> PlaceMap:
    images = np.arange(N * 16, dtype=np.uint8).reshape(N, 4, 4)
    return PlaceMap(index(), images, POSES, np.tile([1.73, 0.0, 0.0, 1.0], (N, 1)))


def change_header(content: bytes, draw: Random) -> Damaged:
    """The header says something else; the numbers are the same."""
    header, body = safetensors_parts(content)
    return Damaged(safetensors_file(change_json(header, draw), body), "either")


def another_array(content: bytes, draw: Random) -> Damaged:
    """One array has a value more, less or another; the checksum is the old one."""
    values, header = safetensors.numpy.load(content), safetensors_parts(content)[0]["__metadata__"]
    name = draw.choice([name for name in sorted(values) if values[name].size])
    array = values[name].copy()
    array.flat[draw.randrange(array.size)] += 1
    values[name] = draw.choice((array, values[name][:-1], values[name].astype(np.float16)))
    return Damaged(safetensors.numpy.save({k: np.ascontiguousarray(v) for k, v in values.items()}, header))


def plain_index(found: Index) -> Any:
    arrays = [found.descriptors, found.times, found.positions]
    return plain([found.width, found.weights_hash, found.distance, found.ids, *arrays])


def plain_map(found: PlaceMap) -> Any:
    return [plain_index(found.index), plain([found.images, found.world_from_place])]


def plain_loops(found: list[Loop]) -> Any:
    return [plain(loop) for loop in found]


def reread(read: Callable[[Path], Any], said: Callable[[bytes], Any]) -> dict[str, Any]:
    """The fields of a road whose result is what a plain parser finds."""
    return {"read": read, "same": lambda found, content: found == said(content)}


def said_lines(content: bytes) -> Any:
    values = [json.loads(line) for line in content.decode().splitlines()]
    for value in values:
        assert type(value["query"]) is int and type(value["match"]) is int
        assert 0 <= value["match"] < value["query"] and 0 <= value["probability"] <= 1
        for name in ("match_from_query", "covariance"):
            value[name] = [[float(number) for number in row] for row in value[name]]
    names = ("query", "match", "match_from_query", "covariance", "probability", "overlap")
    return [[value[name] for name in names] for value in values]


def read_lines(path: Path) -> Any:
    return [
        [one.query, one.match, one.match_from_query.tolist(), one.covariance.tolist(), one.probability, one.overlap]
        for one in read_loops_jsonl(path)
    ]


def change_line(content: bytes, draw: Random) -> Damaged:
    """A line of JSON with another value somewhere."""
    lines = content.decode().splitlines()
    row = draw.randrange(len(lines))
    lines[row] = json.dumps(change_json(json.loads(lines[row]), draw))
    return Damaged("\n".join(lines).encode() + b"\n", "either")


def read_table(path: Path) -> Any:
    return [[*row[:2], np.round(row[2], 6).tolist(), row[3]] for row in read_loops_csv(path)]


def said_table(content: bytes) -> Any:
    rows = [line.split(",") for line in content.decode().splitlines()[1:]]
    for row in rows:
        assert (
            0 <= int(row[1]) < int(row[0]) and 0 <= float(row[9]) <= 1 and 0 <= float((row[10:] and row[10]) or 0) <= 1
        )
    return [[int(row[0]), int(row[1]), _matrix(row[2:9]), float(row[9])] for row in rows]


def either(damage: Damage) -> Damage:
    """The same damage, which a reader may also leave out: lines of unknown kinds, or frames that are found again."""
    return lambda content, draw: Damaged(damage(content, draw).content, "either")


def read_graph(path: Path) -> Any:
    graph = read_g2o(path)
    edges = [[a, b, np.round(pose, 6).tolist(), information.tolist()] for a, b, pose, information in graph.edges]
    return [{frame: np.round(pose, 6).tolist() for frame, pose in graph.poses.items()}, edges]


def said_graph(content: bytes) -> Any:
    poses, edges = {}, []
    for line in content.decode(errors="replace").splitlines():
        kind, *words = line.split() or [""]
        if kind == "VERTEX_SE3:QUAT":
            assert int(words[0]) not in poses
            poses[int(words[0])] = _matrix(words[1:])
        elif kind == "EDGE_SE3:QUAT":
            upper = np.zeros((6, 6))
            upper[np.triu_indices(6)] = [float(word) for word in words[9:]] or np.eye(6)[np.triu_indices(6)]
            edges.append([int(words[0]), int(words[1]), _matrix(words[2:9]), (upper + np.triu(upper, 1).T).tolist()])
    return [poses, edges]


def _matrix(words: list[str]) -> Any:
    """Position and quaternion as a matrix, by the textbook."""
    px, py, pz, x, y, z, w = map(float, words)
    assert abs(np.linalg.norm([x, y, z, w]) - 1) <= 0.01
    x, y, z, w = np.array([x, y, z, w]) / np.linalg.norm([x, y, z, w])
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w), px],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w), py],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y), pz],
        [0, 0, 0, 1],
    ]
    return np.round(np.array(rows, np.float64), 6).tolist()


CLOUDS = [np.arange(12 * (i + 1), dtype=np.float32).reshape(-1, 3) for i in range(N)]


def pack() -> dict[str, bytes]:
    """The files of a pack of five scans."""
    with tempfile.TemporaryDirectory() as folder:
        paths = tuple(Path(folder) / f"{i}.bin" for i in range(N))
        for path, cloud in zip(paths, CLOUDS, strict=True):
            np.c_[cloud, np.zeros(len(cloud), np.float32)].tofile(path)
        names = tuple(path.stem for path in paths)
        recording = Recording("08", names, None, None, None, paths, lambda path, *_: Record(points=read_scan(path)))
        packed(recording, Path(folder) / "packs")
        return {path.name: path.read_bytes() for path in (Path(folder) / "packs").glob("*/*")}


PACK = pack()


def read_pack(path: Path) -> Any:
    points = open_pack(path.parent)["points"]
    return [points[i] for i in range(len(points.offsets) - 1)]


SAFE = {**BYTES, "header": change_header, "array": another_array}
ROADS = (
    Road(
        "index",
        "a.safetensors",
        index().to_bytes(),
        damages=SAFE,
        read=Index.load,
        same=lambda found, content: plain_index(found) == plain_index(index()),
    ),
    Road(
        "map",
        "a.safetensors",
        written(place_map().save, "a.safetensors"),
        damages=SAFE,
        read=PlaceMap.load,
        same=lambda found, content: plain_map(found) == plain_map(place_map()),
    ),
    Road(
        "g2o",
        "loops.g2o",
        written(lambda path: write_g2o(path, LOOPS, POSES), "loops.g2o"),
        damages={**BYTES, "word": either(change_word), "missing": either(drop_word)},
        **reread(read_graph, said_graph),
    ),
    Road(
        "loops, JSON lines",
        "loops.jsonl",
        written(lambda path: write_loops_jsonl(path, LOOPS), "loops.jsonl"),
        damages={**BYTES, "value": change_line},
        **reread(read_lines, said_lines),
    ),
    Road(
        "loops, csv",
        "loops.csv",
        written(lambda path: write_loops_csv(path, LOOPS), "loops.csv"),
        damages=BYTES,
        **reread(read_table, said_table),
    ),
    Road(
        "pack",
        "points.bin",
        PACK["points.bin"],
        damages=BYTES,
        beside={"pack.json": PACK["pack.json"]},
        **as_whole(read_pack, CLOUDS),
    ),
    Road(
        "pack's list",
        "pack.json",
        PACK["pack.json"],
        damages={**BYTES, "value": change_line},
        beside={"points.bin": PACK["points.bin"]},
        **as_whole(read_pack, CLOUDS),
    ),
)
