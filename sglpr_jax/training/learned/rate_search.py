"""Search of the learning rate of a learned method: a short training for each rate of its recipe."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from sglpr_jax.files import read_json, write_json
from sglpr_jax.methods.learned.method import LearnedMethod
from sglpr_jax.progress import Progress, no_progress
from sglpr_jax.training.learned.inputs import Prepared
from sglpr_jax.training.learned.run import train_learned
from sglpr_jax.training.learned.run_files import CONFIG_FILE, RunSettings
from sglpr_jax.training.learned.score import RECALL, ScoreFn

RATES_FILE = "rates.json"


class Stopped(Exception):
    """The search was asked to stop. Its trainings can be resumed."""


def best_rate(
    method: LearnedMethod,
    data: Prepared,
    score: ScoreFn,
    out: Path,
    *,
    seconds: float = 300.0,
    seed: int = 0,
    stopped: Callable[[], bool] = lambda: False,
    report: Callable[[str], None] = lambda line: None,
    progress: Progress = no_progress,
) -> float:
    """Train with each of the three learning rates and return the one with the highest Recall@1.

    The folder gets the trainings and `rates.json` with all scores. Finished trainings are not repeated. A rate whose
    loss is not finite has no score. Of equal scores, the smaller rate wins.

    Arguments:
      method: Method to train.
      data: Training recordings and their inputs.
      score: Scores weights on a held-out recording.
      out: Folder of the search.
      seconds: Training time of each rate.
      seed: Seed of each training.
      stopped: Asked after every step.
      report: Receives lines about the progress.
      progress: Displays the training time.

    Raises:
      FloatingPointError: If the loss is not finite with any rate.
      Stopped: If the search was asked to stop.
    """
    scores: dict[float, float | None] = {}
    for rate in method.recipe.learning_rates:
        settings = RunSettings(learning_rate=rate, seed=seed, seconds=seconds)
        options = {"stopped": stopped, "report": report, "progress": progress}
        scores[rate] = _score_of_rate(method, data, score, settings, out / f"rate-{rate:g}", options)
        report(f"learning rate {rate:g}: {RECALL} {scores[rate]}")
    finite = {rate: found for rate, found in scores.items() if found is not None}
    if not finite:
        raise FloatingPointError(f"{out}: the loss of {method.name} is not finite with any of its learning rates")
    best = max(finite, key=lambda rate: finite[rate])
    recalls = {f"{rate:g}": found for rate, found in scores.items()}
    about = {"method": method.name, "seconds": seconds, "seed": seed}
    write_json(out / RATES_FILE, {**about, RECALL: recalls, "best": best})
    return best


def _score_of_rate(
    method: LearnedMethod,
    data: Prepared,
    score: ScoreFn,
    settings: RunSettings,
    folder: Path,
    options: dict[str, Any],
) -> float | None:
    """Train with one rate and return its Recall@1, or None if its loss is not finite."""
    try:
        resume = (folder / CONFIG_FILE).is_file()
        found = train_learned(method, data, settings, folder, resume=resume, **options)
    except FloatingPointError:
        return None
    if found.seconds < settings.seconds:
        raise Stopped
    kept = folder / "score.json"
    if not kept.is_file():
        write_json(kept, score(found.state.variables))
    return float(read_json(kept)[RECALL])
