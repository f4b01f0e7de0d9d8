"""Results of a training run: its learning curves, and the test on a held-out recording beside other methods."""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console, ConsoleOptions, RenderableType

from sglpr_jax.data.recording import Recording
from sglpr_jax.evaluation import figures, report
from sglpr_jax.evaluation.protocols.protocol import Result
from sglpr_jax.evaluation.scoring import score
from sglpr_jax.evaluation.segmentation import SegmentationScore, segment_recording
from sglpr_jax.files import write_json
from sglpr_jax.methods.names import BESIDE, NETWORK
from sglpr_jax.methods.registry import method_beside, network
from sglpr_jax.models.params import Params
from sglpr_jax.progress import Progress, no_progress
from sglpr_jax.retrieval.embed import embed
from sglpr_jax.training.callbacks import Callback
from sglpr_jax.training.loss import TERM_NAMES
from sglpr_jax.training.metrics_log import read_metrics
from sglpr_jax.training.trainer import METRICS_FILE

ROTATION_SEED = 0
LEARNING_CURVES = "learning-curves.png"
_PANELS = {
    "loss": ("loss", *TERM_NAMES),
    "score: recall@1 of held-out or training places": ("score",),
    "gradient norm": ("gradient_norm",),
}
"""Title of each panel, and the names of its curves in the metrics file."""


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
        scores = {
            title: {name: report.to_json(found) for name, found in methods.items()}
            for title, methods in self.results.items()
        }
        segmentation = {} if self.semantics is None else {"segmentation": self.semantics.to_json()}
        return {"sequence": self.sequence, **scores, **segmentation}

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[RenderableType]:
        for name, methods in self.results.items():
            title = f"sequence {self.sequence}, {name}"
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
    """Score a trained network on a recording, raw and with every scan rotated at random.

    Arguments:
      params: Parameters of the trained network.
      recording: Recording with poses.
      folder: Folder for descriptors, figures and results.json.
      methods: Handcrafted methods to compare with, `untrained` (the network with random weights drawn from `seed`) or
        `shipped` (the network with `DEFAULT_WEIGHTS`).
      seed: Seed of the weights of `untrained`.
      progress: Reports the progress of each embedding.

    Raises:
      ValueError: If a method does not fit the recording.
    """
    folder.mkdir(parents=True, exist_ok=True)
    beside = {name: method_beside(params, name, recording, seed=seed) for name in methods}
    results: dict[str, dict[str, list[Result]]] = {}
    for title, rotation_seed in (("raw", None), ("rotated", ROTATION_SEED)):
        results[title] = {}
        for name, method in {NETWORK: network(params), **beside}.items():
            with progress(f"embed {title} {name}", len(recording)) as show:
                file = embed(method, recording, rotation_seed=rotation_seed, on_progress=show)
            file.save(folder / f"{name}-{title}.npz")
            results[title][name] = score(file)
        if figures.can_draw():
            _draw(results[title], recording, folder, title)
    semantics = None
    if params.config.segments and recording.has_labels:
        semantics = segment_recording(params, recording, folder, progress=progress)
    found = FinalTest(recording.name, results, semantics)
    write_json(folder / "results.json", found.to_json())
    return found


def _draw(results: Mapping[str, Sequence[Result]], recording: Recording, folder: Path, title: str) -> None:
    top1 = {name: scored[0] for name, scored in results.items()}
    curves = {name: result.curve for name, result in top1.items() if result.curve is not None}
    if curves:  # empty if the recording has no revisit
        picture = figures.precision_recall(curves, title=f"{recording.name}, {title}: top-1")
        figures.save(picture, folder / f"precision-recall-{title}.png")
    decisions = top1[NETWORK].decisions
    if decisions is not None and recording.positions is not None:
        figures.save(figures.trajectory(recording.positions, decisions), folder / f"trajectory-{title}.png")


class LearningCurves(Callback):
    """Draws the learning curves of the run in `folder` when training ends, if matplotlib (extra `viz`) is installed."""

    def __init__(self, folder: Path):
        self._folder = folder

    def on_end(self, step: int) -> None:
        """Draw loss terms, score and gradient norm of the whole run, including those of earlier processes."""
        lines = read_metrics(self._folder / METRICS_FILE)
        if not lines or not figures.can_draw():
            return
        panels = {
            title: {
                name: [(line["step"], line[name]) for line in lines if line.get(name) is not None]
                for name in names
                if any(line.get(name) is not None for line in lines)
            }
            for title, names in _PANELS.items()
        }
        figures.save(figures.learning_curves(panels), self._folder / LEARNING_CURVES)
