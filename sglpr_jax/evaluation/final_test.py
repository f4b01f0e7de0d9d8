"""Tests a trained network on a held-out recording, and other methods for comparison."""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console, ConsoleOptions, RenderableType

from sglpr_jax.data.recording import Recording
from sglpr_jax.evaluation import figures, report
from sglpr_jax.evaluation.protocols import score
from sglpr_jax.evaluation.protocols.result import Result
from sglpr_jax.evaluation.segmentation import SegmentationScore, segment_recording
from sglpr_jax.files import write_json
from sglpr_jax.methods.names import BESIDE, NETWORK
from sglpr_jax.methods.registry import method_beside, network
from sglpr_jax.models.weights import Params
from sglpr_jax.progress import Progress, no_progress
from sglpr_jax.retrieval.embed import embed

ROTATION_SEED = 0


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class FinalTest(report.PrintsItself):
    """Scores of a trained network and of the methods it is compared with. Prints itself as tables."""

    sequence: str
    results: Mapping[str, Mapping[str, Sequence[Result]]]
    """Results for `raw` and `rotated` scans, by the name of the method."""
    semantics: SegmentationScore | None
    """Score of the segmentation head. None without such a head or without labels."""

    def to_json(self) -> dict[str, Any]:
        """Return plain values for `json.dump`."""
        scores: dict[str, Any] = {
            scans: {name: report.to_json(results) for name, results in methods.items()}
            for scans, methods in self.results.items()
        }
        if self.semantics is not None:
            scores["segmentation"] = self.semantics.to_json()
        return {"sequence": self.sequence, **scores}

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[RenderableType]:
        for scans, methods in self.results.items():
            title = f"sequence {self.sequence}, {scans}"
            yield report.results_table(methods[NETWORK], title=f"{title}: {NETWORK}")
            yield report.comparison(methods, title=title)
        if self.semantics is not None:
            yield self.semantics


def final_test(
    params: Params,
    recording: Recording,
    folder: Path,
    *,
    methods: Sequence[str] = BESIDE,
    seed: int = 0,
    progress: Progress = no_progress,
) -> FinalTest:
    """Score a trained network on a recording, with the scans as they are (`raw`) and rotated at random (`rotated`).

    Arguments:
      params: Parameters of the trained network.
      recording: Recording with poses.
      folder: Folder for descriptors, figures and results.json.
      methods: Handcrafted methods to compare with, `untrained` (the network with random weights drawn from `seed`) or
        `shipped` (the network with `DEFAULT_WEIGHTS`).
      seed: Seed of the weights of `untrained`.
      progress: Reports the progress of each embedding.

    Raises ValueError if a method does not fit the recording.
    """
    folder.mkdir(parents=True, exist_ok=True)
    tested_methods = {NETWORK: network(params)}
    for name in methods:
        tested_methods[name] = method_beside(params, name, ready_made=recording.has_images, seed=seed)
    results: dict[str, dict[str, list[Result]]] = {}
    for scans, rotation_seed in (("raw", None), ("rotated", ROTATION_SEED)):
        results[scans] = {}
        for name, method in tested_methods.items():
            with progress(f"embed {scans} {name}", len(recording)) as show:
                file = embed(method, recording, rotation_seed=rotation_seed, on_progress=show)
            file.save(folder / f"{name}-{scans}.npz")
            results[scans][name] = score(file)
        _draw_figures(results[scans], recording, folder, scans)
    semantics = None
    if params.config.segments and recording.has_labels:
        semantics = segment_recording(params, recording, folder, progress=progress)
    test = FinalTest(recording.name, results, semantics)
    write_json(folder / "results.json", test.to_json())
    return test


def _draw_figures(results: Mapping[str, Sequence[Result]], recording: Recording, folder: Path, scans: str) -> None:
    """Draw the curves of all methods and the decisions of the network by the first protocol, top-1 F1max."""
    curves = {name: top1.curve for name, (top1, *_) in results.items() if top1.curve is not None}
    if curves:  # empty if the recording has no revisit
        picture = figures.precision_recall(curves, title=f"{recording.name}, {scans}: top-1")
        figures.save(picture, folder / f"precision-recall-{scans}.png")
    decisions = results[NETWORK][0].decisions
    if decisions is not None and recording.positions is not None:
        figures.save(figures.trajectory(recording.positions, decisions), folder / f"trajectory-{scans}.png")
