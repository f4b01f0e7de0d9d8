"""What commands answer to a damaged file: scores, places of a map, exported weights, semantic maps."""

import functools
import json
import tempfile
from pathlib import Path
from typing import Any

import jax
import numpy as np

from sglpr_jax.cli.export import ExportCommand, export
from sglpr_jax.data.mounting import MODEL_HEIGHT_M
from sglpr_jax.evaluation.inputs.methods import read_methods
from sglpr_jax.evaluation.scoring import evaluate_methods
from sglpr_jax.loops.probability import AdditiveModel, Curve, LoopModel
from sglpr_jax.maps.place_map import PlaceMap
from sglpr_jax.models.params import Params
from sglpr_jax.models.weights import as_tree, by_name, for_places, weights_hash
from sglpr_jax.models.weights_file import CONFIG_FILE, WEIGHTS_FILE, load
from sglpr_jax.retrieval.descriptor_file import DescriptorFile
from sglpr_jax.retrieval.index import Index
from sglpr_jax.se3 import transform

from .archives import ABOUT, NPZ, arrays_of, change_about, npz
from .damage import BYTES
from .places import SAFE, written
from .road import Road, plain
from .run_files import CONFIG, CONFIG_JSON, WEIGHTS, break_tensor, change_header, stored

DRAWN = np.random.default_rng(1)
LAP = 40
"""Frames of a round, which is driven twice."""
TURN = np.arange(2 * LAP) * 2 * np.pi / LAP
ROUND = {
    "ids": np.array([f"{i:06d}" for i in range(2 * LAP)]),
    "descriptors": np.tile(DRAWN.normal(size=(LAP, 4)), (2, 1)).astype(np.float32),
    "positions": np.stack([60 * np.cos(TURN), 60 * np.sin(TURN), 0 * TURN], axis=1),
    "times": np.arange(2.0 * LAP),
}
EVALUATED = npz({"about": np.array(json.dumps(ABOUT)), **ROUND})


def scores(path: Path) -> Any:
    """What bin/evaluate writes into results.json."""
    return evaluate_methods(read_methods((path,)), file=path).to_json()["results"]


def scores_said(content: bytes) -> Any:
    """The scores of the arrays by a plain reader."""
    arrays = arrays_of(content)
    about = json.loads(str(arrays.pop("about")))
    file = DescriptorFile(**{name: about[name] for name in ABOUT if name != "format"}, **_as_fields(arrays))
    return evaluate_methods({"a": file}).to_json()["results"]


def _as_fields(arrays: dict[str, np.ndarray]) -> dict[str, Any]:
    return {"positions": None, "times": None, **arrays, "ids": tuple(arrays["ids"].tolist())}


PARAMS = Params(as_tree(WEIGHTS), CONFIG)
ALWAYS = LoopModel(AdditiveModel({"deviation": Curve((0.0,), (0.0,))}, 1.0), "everything")
IMAGES = DRAWN.integers(0, 255, (6, 16, 16)).astype(np.uint8) * (DRAWN.random((6, 16, 16)) < 0.5)


@functools.cache
def place_map() -> PlaceMap:
    """Six places of a street."""
    index = Index.empty(CONFIG.head.descriptor_size, weights_hash=weights_hash(PARAMS))
    poses = np.stack([transform(30.0 * i, 0.0, 0.0) for i in range(6)])
    index.add(DRAWN.normal(size=(6, 8)), positions=poses[:, :3, 3], ids=[f"08/{i}" for i in range(6)])
    return PlaceMap(index, IMAGES, poses, np.tile([MODEL_HEIGHT_M, 0.0, 0.0, 1.0], (6, 1)))


def relocated(path: Path) -> Any:
    """Where an image is in the map, by three answers."""
    places = PlaceMap.load(path, weights_hash=weights_hash(PARAMS))
    found = places.relocate(PARAMS, IMAGES[2].astype(np.float32), model=ALWAYS, candidates=3)
    return [[one.place, plain(one.world_from_query), one.probability] for one in found]


@functools.cache
def relocated_whole() -> Any:
    with tempfile.TemporaryDirectory() as folder:
        place_map().save(Path(folder) / "a.safetensors")
        return relocated(Path(folder) / "a.safetensors")


def exported(path: Path) -> Any:
    """The weights that bin/export writes, in another folder."""
    with tempfile.TemporaryDirectory() as folder:
        out = export(ExportCommand(out=Path(folder) / "out", weights=str(path.parent)))
        return plain(by_name(jax.device_get(load(out).weights)))


def same_exported(found: Any, content: bytes) -> bool:
    return found == plain(by_name(for_places(PARAMS).weights))


ROADS = (
    Road(
        "evaluate",
        "08.npz",
        EVALUATED,
        scores,
        lambda found, content: found == scores_said(content),
        {**NPZ, "about": change_about},
        cost=3,
    ),
    Road(
        "relocalize",
        "a.safetensors",
        written(place_map().save, "a.safetensors"),
        relocated,
        lambda found, content: found == relocated_whole(),
        SAFE,
        cost=3,
        slow=True,
    ),
    Road(
        "export",
        WEIGHTS_FILE,
        stored(WEIGHTS),
        exported,
        same_exported,
        {**BYTES, "tensor": break_tensor, "header": change_header},
        {CONFIG_FILE: CONFIG_JSON},
        cost=2,
    ),
)
