"""Contenders of the comparison of learned methods, and their scores on recordings that were not used for training.

The name of a contender is a handcrafted method (`scan-context`), shipped weights (`sglpr`), an untrained network
(`rinet@random:0`), or a folder of weights (`rinet-0`, `rinet-0/weights-4000`) in the folder of the runs.
"""

import json
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import tyro

import sglpr_jax
from benchmarks.learned.data import TEST, TOWN, folders, recordings_of
from sglpr_jax.data.readers import open_recording
from sglpr_jax.data.recording import Recording
from sglpr_jax.evaluation.protocols.pairs import PAIRS_F1MAX
from sglpr_jax.evaluation.protocols.recall import BEVPLACE_NCLT_RECALL, BEVPLACE_RECALL_AT_1
from sglpr_jax.evaluation.protocols.top1 import TOP1_F1MAX
from sglpr_jax.files import write_json
from sglpr_jax.methods.handcrafted import HANDCRAFTED
from sglpr_jax.methods.learned import LEARNED
from sglpr_jax.methods.learned.trained import RANDOM
from sglpr_jax.methods.method import Method, Takes
from sglpr_jax.methods.registry import method_named, method_with_weights, network, trained_method
from sglpr_jax.models.sglpr import init
from sglpr_jax.models.weights_file import LAST_WEIGHTS
from sglpr_jax.retrieval.descriptor_file import DescriptorFile
from sglpr_jax.retrieval.distances import distance_function
from sglpr_jax.retrieval.embed import embed
from sglpr_jax.training.trainer import SCORES_FILE
from sglpr_jax.training.validation import recall_at_1

ROTATION_SEED = 0


class Entry(NamedTuple):
    """A contender."""

    name: str
    takes: Takes
    method: Callable[[Recording], Method]
    """Returns the method for the scans of a recording."""
    images: int | None = None
    """Number of images that it was trained with. None: not trained here."""
    seconds: float | None = None
    """Training time in seconds."""


def entry(name: str, data: Path) -> Entry:
    """The contender called `name`. Raises FileNotFoundError if there is no method, weights or run of that name."""
    if name in HANDCRAFTED:
        takes = HANDCRAFTED[name].takes
        return Entry(name, takes, lambda recording: method_named(name, ready_made=recording.has_images))
    method, _, weights = name.rpartition("@")  # METHOD@random:SEED is untrained
    if name in sglpr_jax.shipped_weights():
        params = sglpr_jax.load(name)
        return Entry(name, "images", lambda recording: network(params))
    if weights.startswith(RANDOM) and method in LEARNED:
        learned = LEARNED[method]
        return Entry(name, learned.takes, lambda recording: trained_method(learned, weights), 0, 0.0)
    if weights.startswith(RANDOM):
        params = init(jax.random.key(int(weights.removeprefix(RANDOM))), preset=method)
        return Entry(name, "images", lambda recording: network(params), 0, 0.0)
    folder = data / "runs" / name
    folder = folder / LAST_WEIGHTS if (folder / LAST_WEIGHTS / "config.json").is_file() else folder
    trained = method_with_weights(str(folder))
    images, seconds = _training_effort(folder)
    return Entry(name, trained.takes, lambda recording: trained, images=images, seconds=seconds)


def _training_effort(folder: Path) -> tuple[int, float]:
    """Number of training images and training time (s) of weights, from their configuration or the run's scores."""
    config = json.loads((folder / "config.json").read_text())
    if "images" in config:
        return config["images"], config["seconds"]
    lines = [json.loads(line) for line in (folder.parent / SCORES_FILE).read_text().splitlines()]
    snapshot = folder.name.removeprefix(f"{LAST_WEIGHTS}-")  # number of images, or the last weights
    line = next((line for line in lines if str(line["images"]) == snapshot), lines[-1])
    return line["images"], line["seconds"]


class Test(NamedTuple):
    """A recording to score on."""

    name: str
    recording: Recording
    database: Recording | None = None
    """Another session, sensor or lane of the same town. None: the recording's own earlier scans."""
    rotated: bool = False


def score(
    entries: tyro.conf.Positional[tuple[str, ...]],
    *,
    data: Path = Path("build/learned"),
    kitti: Path | None = None,
    only: str = "",
) -> None:
    """Score contenders and print a line for each recording.

    Every contender describes the test recordings of `data`, and the images of KITTI if it takes images. The town and
    KITTI are also described with every scan rotated. A result is a JSON file of one contender and one recording,
    in the folder `scores` of `data`. Existing results are kept.

    Args:
        entries: contenders, see the head of this file.
        data: folder of the recordings and of the runs.
        kitti: folder of KITTI's images, NN/imgs/*.png with NN/pose.txt.
        only: beginning of the names of the test recordings to score on.
    """
    tests = [test for test in [*_simulated(data), *_kitti(kitti)] if test.name.startswith(only)]
    for name in entries:
        contender = entry(name, data)
        for test in tests:
            if _fits(contender, test):
                result = _result(contender, test, data / "scores" / name.replace("/", "_").replace(":", "-"))
                scores = (f"{key} {value:.3f}" for key, value in result["scores"].items())
                print(f"{name}, {test.name}: {', '.join(scores)}", flush=True)


def _simulated(data: Path) -> Iterator[Test]:
    by_world: dict[str, tuple[str, Recording]] = {}
    for folder in folders(data, TEST):
        recordings = recordings_of(folder)
        if folder.name.startswith("days"):
            yield Test(folder.name, recordings[1], recordings[0])
            continue
        for recording in recordings:
            name = f"{folder.name}-{recording.name}"
            yield Test(name, recording)
            if folder.name == TOWN:
                yield Test(f"{name}-rotated", recording, rotated=True)
            other, database = by_world.setdefault(recording.world or name, (name, recording))
            if other != name:
                yield Test(f"{name}-in-{other}", recording, database)  # another sensor or lane


def _kitti(root: Path | None) -> Iterator[Test]:
    for seq in () if root is None else ("00", "02", "06"):
        for rotated in (False, True):
            yield Test(f"kitti-{seq}{'-rotated' if rotated else ''}", open_recording(root, seq), rotated=rotated)


def _fits(contender: Entry, test: Test) -> bool:
    """Whether the recording has what the contender needs."""
    if contender.takes == "labelled points":
        return test.recording.has_labels
    return contender.takes == "images" or not test.recording.has_images


def _result(contender: Entry, test: Test, folder: Path) -> Mapping[str, Any]:
    """Returns the stored scores of a contender on a recording, or computes and stores them."""
    path = folder / f"{test.name}.json"
    if path.is_file():
        return json.loads(path.read_text())
    file = _described(contender, test.recording, rotated=test.rotated)
    if test.database is not None:
        scores = {"recall": BEVPLACE_NCLT_RECALL(_described(contender, test.database), file).score}
    else:
        scores = _scores(file, split=test.name.startswith("kitti-"))
    about = {"images": contender.images, "seconds": contender.seconds, "numbers": file.descriptors.shape[1]}
    result = {"entry": contender.name, "test": test.name, **about, "weights": file.weights_hash, "scores": scores}
    write_json(path, result)
    return result


def _described(contender: Entry, recording: Recording, *, rotated: bool = False) -> DescriptorFile:
    print(f"describing {recording.name} by {contender.name}", file=sys.stderr, flush=True)
    return embed(contender.method(recording), recording, rotation_seed=ROTATION_SEED if rotated else None, batch=16)


def _scores(file: DescriptorFile, *, split: bool) -> dict[str, float]:
    """Return top-1 F1max, F1max of pairs, Recall@1 within 5 m and, for a split sequence, that of BEVPlace++."""
    assert file.positions is not None
    recall = recall_at_1(file.descriptors, file.positions, file.times, distance_function(file.distance))
    scores = {"top1": TOP1_F1MAX(file).score, "pairs": PAIRS_F1MAX(file).score, "recall": recall}
    return scores | ({"split recall": BEVPLACE_RECALL_AT_1(file).score} if split else {})
