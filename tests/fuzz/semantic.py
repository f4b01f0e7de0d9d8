"""The semantic maps of bin/segment, of scans of which one is damaged."""

import dataclasses
import functools
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from sglpr_jax.cli.recording import RecordingOptions
from sglpr_jax.cli.segment import SegmentCommand, segment_recording
from sglpr_jax.data.recording import Record
from sglpr_jax.models.params import Params
from sglpr_jax.models.weights import as_tree, weight_shapes
from sglpr_jax.models.weights_file import save
from sglpr_jax.retrieval.image_maps import semantic_map

from .damage import BYTES
from .road import FolderRoad, plain
from .run_files import CONFIG

DRAWN = np.random.default_rng(2)
MODEL = dataclasses.replace(CONFIG, categories=20)
SCANS = {f"{i}.bin": DRAWN.normal(scale=6, size=(60, 4)).astype("<f4").tobytes() for i in range(3)}


@functools.cache
def params() -> Params:
    """A model that segments, with weights drawn at random."""
    shapes = weight_shapes(MODEL)
    return Params(as_tree({name: DRAWN.normal(size=shape).astype(np.float32) for name, shape in shapes.items()}), MODEL)


def segmented(scans: Path) -> Any:
    """The maps that bin/segment writes, in another folder."""
    with tempfile.TemporaryDirectory() as folder:
        save(params(), Path(folder) / "weights")
        source = RecordingOptions(format="kitti", sensor_height=1.73)
        command = SegmentCommand(scans, Path(folder) / "out", weights=str(Path(folder) / "weights"), source=source)
        written = sorted(segment_recording(command).glob("*.png"))
        return [plain(np.asarray(Image.open(path))) for path in written]


def said_maps(files: Mapping[str, bytes]) -> Any:
    """The maps of the points that a plain parser finds."""
    clouds = (np.frombuffer(content, "<f4").reshape(-1, 4)[:, :3] for _, content in sorted(files.items()))
    maps = (semantic_map(params(), Record(points=cloud)) for cloud in clouds)
    return [plain(found.predicted.astype(np.uint8)) for found in maps]


ROADS = (
    FolderRoad(
        "segment",
        "scans",
        lambda: SCANS,
        segmented,
        same=lambda found, files: found == said_maps(files),
        damages=lambda file: BYTES,
        cost=10,
        slow=True,
    ),
)
