"""Scores contenders on recordings that none of them was trained on.

    python -m benchmarks.learned.score sglpr rinet-0 rinet-0/weights-4000 rinet@random:0 scan-context --kitti KITTI_BEV
    python -m benchmarks.learned.score sglpr bevplace++-0 --verify

Every contender (`entries`) describes the test recordings of `data`, raw and with every scan rotated, and the images of
KITTI if it takes images. A result is a JSON file of one contender and one recording. Existing results are kept.
"""

import functools
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tyro

from benchmarks.learned.data import TEST, folders
from benchmarks.learned.entries import Entry, entry
from benchmarks.learned.verified import images_of, verified
from sglpr_jax.data.readers import open_recording, recording_names
from sglpr_jax.data.recording import Recording
from sglpr_jax.evaluation.protocols.bevplace_nclt_recall import bevplace_nclt_recall
from sglpr_jax.evaluation.protocols.bevplace_recall_at_1 import bevplace_recall_at_1
from sglpr_jax.evaluation.protocols.pairs_f1max import PAIRS_F1MAX
from sglpr_jax.evaluation.protocols.source import Source, TopK
from sglpr_jax.evaluation.protocols.top1_f1max import top1_f1max
from sglpr_jax.files import write_json
from sglpr_jax.retrieval.descriptor_file import DescriptorFile
from sglpr_jax.retrieval.embed import embed
from sglpr_jax.revisits import database_end, has_near
from sglpr_jax.training.learned.score import FOUND_M

ROTATION_SEED = 0
SPLIT = ("00", "02", "05", "06")
"""Sequences of KITTI with a published split into map and queries."""


class Test(NamedTuple):
    """A recording to score on."""

    name: str
    recording: Recording
    database: Recording | None = None
    """Earlier session of the same town. None: the recording's own earlier scans."""
    rotated: bool = False

    @property
    def is_kitti(self) -> bool:
        """Whether this is a sequence of KITTI's images."""
        return self.name.startswith("kitti-")


def main(
    entries: tyro.conf.Positional[tuple[str, ...]],
    *,
    data: Path = Path("build/learned"),
    runs: Path = Path("build/learned/runs"),
    out: Path = Path("build/learned/scores"),
    kitti: Path | None = None,
    kitti_seqs: Sequence[str] = ("00", "02", "06"),
    part: str = TEST,
    only: str = "",
    verify: bool = False,
) -> None:
    """Score contenders and print a line for each recording.

    Args:
        entries: contenders, as in `entries`.
        data: folder of the recordings.
        runs: folder of the runs.
        out: folder of the results.
        kitti: folder of KITTI's images, NN/imgs/*.png with NN/pose.txt.
        kitti_seqs: sequences of KITTI to score on.
        part: part of `data` to score on. Scores on "train" distinguish networks that did not learn from those that do
            not generalise.
        only: beginning of the names of the test recordings to score on.
        verify: also score after verification of the nearest places.
    """
    tests = [one for one in [*_simulated(data, part), *_kitti(kitti, kitti_seqs)] if one.name.startswith(only)]
    for name in entries:
        contender = entry(name, runs)
        for test in tests:
            if _fits(contender, test):
                found = _result(contender, test, out / contender.file_name, verify=verify)
                scores = (f"{key} {value:.3f}" for key, value in found["scores"].items())
                print(f"{name}, {test.name}: {', '.join(scores)}", flush=True)


def _simulated(data: Path, part: str) -> Iterator[Test]:
    for folder in folders(data, part):
        names = recording_names(folder)
        if folder.name.startswith("days"):
            first, second = (open_recording(folder, name) for name in names)
            yield Test(folder.name, second, first)
            continue
        for name in names:
            recording = open_recording(folder, name)
            yield Test(f"{folder.name}-{name}", recording)
            yield Test(f"{folder.name}-{name}-rotated", recording, rotated=True)


def _kitti(root: Path | None, seqs: Sequence[str]) -> Iterator[Test]:
    if root is None:
        return
    for seq in seqs:
        recording = open_recording(root, seq)
        yield Test(f"kitti-{seq}", recording)
        yield Test(f"kitti-{seq}-rotated", recording, rotated=True)


def _fits(contender: Entry, test: Test) -> bool:
    """Whether the recording has what the contender needs."""
    if contender.takes == "labelled points":
        return test.recording.has_labels
    return contender.takes == "images" or not test.recording.has_images


def _result(contender: Entry, test: Test, folder: Path, *, verify: bool) -> Mapping[str, Any]:
    """Return the scores of a contender on a recording, computed unless they are known."""
    path = folder / f"{test.name}.json"
    known = json.loads(path.read_text()) if path.is_file() else None
    wanted = verify and test.database is None and not test.rotated
    if known is not None and (not wanted or "verified top1" in known["scores"]):
        return known
    file = _described(contender, test.recording, rotated=test.rotated)
    if test.database is not None:
        scores = {"recall": bevplace_nclt_recall(_described(contender, test.database), file).score}
    else:
        scores = _scores(file, split=test.is_kitti and test.name.split("-")[1] in SPLIT)
    if wanted:
        images = _images(test.recording)
        scores |= {f"verified {name}": score for name, score in _scores(verified(file, images)).items()}
    about = {"images": contender.images, "seconds": contender.seconds, "numbers": file.descriptors.shape[1]}
    found = {"entry": contender.name, "test": test.name, **about, "weights": file.weights_hash, "scores": scores}
    folder.mkdir(parents=True, exist_ok=True)
    write_json(path, found)
    return found


def _described(contender: Entry, recording: Recording, *, rotated: bool = False) -> DescriptorFile:
    print(f"describing {recording.name} by {contender.name}", file=sys.stderr, flush=True)
    return embed(contender.method(recording), recording, rotation_seed=ROTATION_SEED if rotated else None, batch=16)


@functools.lru_cache(maxsize=4)
def _images(recording: Recording) -> np.ndarray:
    return images_of(recording, range(len(recording)))


def _scores(source: Source, *, split: bool = False) -> dict[str, float]:
    """Return top-1 F1max, F1max of pairs, Recall@1 within 5 m and, for a split sequence, that of BEVPlace++."""
    top1 = top1_f1max(source)
    found = {"top1": top1.score}
    if not isinstance(source, TopK):
        found["pairs"] = PAIRS_F1MAX(source).score
    found["recall"] = _recall(source, top1.answers)
    if split and not isinstance(source, TopK):
        found["split recall"] = bevplace_recall_at_1(source).score
    return found


def _recall(source: Source, answers: np.ndarray | None) -> float:
    """Return the fraction of the revisits that are answered with a place within 5 m, in x and y."""
    assert source.positions is not None
    assert answers is not None
    places = source.positions[:, :2]
    queries = np.flatnonzero(ends := database_end(len(places), times=source.times))
    revisited = queries[has_near(places[queries], places, ends[queries], lambda apart: apart <= FOUND_M)]
    apart = np.linalg.norm(places[revisited] - places[answers[revisited]], axis=1)
    return float(np.mean((apart <= FOUND_M) & (answers[revisited] >= 0)))


if __name__ == "__main__":
    tyro.cli(main)
