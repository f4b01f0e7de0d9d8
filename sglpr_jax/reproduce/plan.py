"""What a reproduction will do, said before it is done: which runs are missing, and about how long they take."""

import time
from collections.abc import Sequence
from dataclasses import dataclass

import jax

from sglpr_jax.reproduce.experiments import EXPERIMENTS, VARIANTS
from sglpr_jax.reproduce.runs import Runs
from sglpr_jax.revisits import revisits
from sglpr_jax.training.batches import TupleBatches, tuple_pool
from sglpr_jax.training.state import new_state
from sglpr_jax.training.step import train_step

TIMED_STEPS = 3


@dataclass(frozen=True)
class Plan:
    """The runs that some experiments rest on, and those of them still to be trained, as (variant, recording)."""

    runs: tuple[tuple[str, str], ...]
    missing: tuple[tuple[str, str], ...]
    steps: int
    without_revisits: tuple[str, ...] = ()
    """The recordings to be tested on that never come back: nothing scores there."""

    def text(self, seconds_per_step: float | None) -> str:
        """The plan in words."""
        done = len(self.runs) - len(self.missing)
        lines = [f"{len(self.runs)} leave-one-out runs of {self.steps} steps, {done} of them there already"]
        for variant in dict.fromkeys(variant for variant, _ in self.missing):
            recordings = ", ".join(seq for name, seq in self.missing if name == variant)
            lines.append(f"  {VARIANTS[variant].label}: to train for {recordings}")
        if self.without_revisits:
            lines.append(f"no revisits in {', '.join(self.without_revisits)}: no scores there, and no means")
        if self.missing and seconds_per_step is not None:
            minutes = len(self.missing) * self.steps * seconds_per_step / 60
            lines.append(f"about {minutes:.0f} min of training ({seconds_per_step:.2g} s a step), and compilation")
        return "\n".join(lines)


def make_plan(runs: Runs, names: Sequence[str], seqs: Sequence[str]) -> Plan:
    """The plan for these experiments and test recordings.

    What is tested across sessions needs one run of each variant only. Raises ValueError where a run has other settings.
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
    """Seconds that a training step takes, measured on the run's own first batches; compiles what the run needs."""
    config = runs.config_of(variant)
    recordings = runs.recordings_but(seq)
    state, batches = new_state(config), TupleBatches(recordings, tuple_pool(recordings, config), config)
    seconds = []
    for step in range(1 + TIMED_STEPS):
        since = time.perf_counter()
        state, metrics = train_step(state, batches.batch(step), config=config)
        jax.block_until_ready(metrics)
        seconds.append(time.perf_counter() - since)
    return sum(seconds[1:]) / TIMED_STEPS
