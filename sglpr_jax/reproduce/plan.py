"""Plan of a reproduction: the missing runs and the estimated training time."""

import time
from collections.abc import Sequence
from dataclasses import dataclass

import jax

from sglpr_jax.reproduce.experiments import EXPERIMENTS, VARIANTS
from sglpr_jax.reproduce.runs import Runs
from sglpr_jax.revisits import revisits
from sglpr_jax.training.batches import batches_of, tuple_pool
from sglpr_jax.training.image_network import ImageNetwork
from sglpr_jax.training.step import train_step

TIMED_STEPS = 3


@dataclass(frozen=True)
class Plan:
    """The runs that the experiments need, and those that are not trained yet, as (variant, recording)."""

    runs: tuple[tuple[str, str], ...]
    missing: tuple[tuple[str, str], ...]
    steps: int
    without_revisits: tuple[str, ...] = ()
    """Test recordings without revisits. They have no scores."""

    def text(self, seconds_per_step: float | None) -> str:
        """Describe the plan."""
        done = len(self.runs) - len(self.missing)
        lines = [f"{len(self.runs)} leave-one-out runs of {self.steps} steps, {done} of them already trained"]
        for variant in dict.fromkeys(variant for variant, _ in self.missing):
            recordings = ", ".join(seq for name, seq in self.missing if name == variant)
            lines.append(f"  {VARIANTS[variant].label}: to train for {recordings}")
        if self.without_revisits:
            lines.append(f"no revisits in {', '.join(self.without_revisits)}: no scores for them, and no means")
        if self.missing and seconds_per_step is not None:
            minutes = len(self.missing) * self.steps * seconds_per_step / 60
            lines.append(f"about {minutes:.0f} min of training ({seconds_per_step:.2g} s a step), plus compilation")
        return "\n".join(lines)


def make_plan(runs: Runs, names: Sequence[str], seqs: Sequence[str]) -> Plan:
    """Return the plan for these experiments and test recordings.

    Experiments across sessions need only one run of each variant. Raises ValueError if a run has other settings.
    """
    needed = {}
    for name in names:
        of_one = seqs[:1] if EXPERIMENTS[name].across_sessions else seqs
        needed |= {(variant, seq): None for variant in EXPERIMENTS[name].variants for seq in of_one}
    missing = tuple(run for run in needed if not runs.is_trained(*run))
    scored = () if all(EXPERIMENTS[name].across_sessions for name in names) else seqs
    return Plan(tuple(needed), missing, runs.config.steps, tuple(seq for seq in scored if not _comes_back(runs, seq)))


def _comes_back(runs: Runs, seq: str) -> bool:
    """Whether a recording has a revisit, by the rule of top-1 F1max."""
    recording = runs.recording(seq)
    return recording.positions is None or bool(revisits(recording.positions, times=recording.times).any())


def time_a_step(runs: Runs, variant: str, seq: str) -> float:
    """Measure the duration of a training step in seconds, on the first batches of the run. The program is compiled
    first."""
    config = runs.config_of(variant)
    recordings = runs.recordings_but(seq)
    network, batches = ImageNetwork(config), batches_of(recordings, tuple_pool(recordings, config), config)
    state = network.new_state()
    seconds = []
    for step in range(1 + TIMED_STEPS):
        since = time.perf_counter()
        state, metrics = train_step(state, batches.batch(step), network=network)
        jax.block_until_ready(metrics)
        seconds.append(time.perf_counter() - since)
    return sum(seconds[1:]) / TIMED_STEPS
