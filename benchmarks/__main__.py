"""Runs a benchmark: `python -m benchmarks GROUP NAME --help`. Without arguments it lists all."""

import importlib
import sys
from collections.abc import Callable
from typing import NamedTuple

import tyro


class Program(NamedTuple):
    """A benchmark: a function of a module below `benchmarks`, whose arguments are the flags."""

    module: str
    function: str
    summary: str

    def load(self) -> Callable[..., None]:
        """The function. Only its module is imported."""
        return getattr(importlib.import_module(f"benchmarks.{self.module}"), self.function)


PROGRAMS = {
    "goldens": Program("goldens", "main", "whether the commands write the same as before a change"),
    "loops": Program("quality.loops", "loops", "loops of simulated drives, ours and other methods'"),
    "loops images": Program("quality.loops", "images", "loops of ready-made images, and F1max after verification"),
    "loops evidence": Program("quality.lookalikes", "evidence", "the right place beside the best lookalike"),
    "loops fit": Program("quality.fit", "fit_model", "fits and writes loops/probability.json"),
    "sessions": Program("quality.sessions", "sessions", "transforms between pairs of drives, and invented ones"),
    "poses pairs": Program("quality.poses", "pairs", "errors of pairs of revisits against their covariances"),
    "poses search": Program("quality.poses", "search", "roll, pitch and height of loops of whole drives"),
    "maps cloud": Program("quality.maps", "cloud", "relocalisation in a point cloud map"),
    "maps moving": Program("quality.maps", "moving", "moving objects in a point cloud"),
    "maps sensors": Program("quality.maps", "sensors", "map of one sensor, queries of another"),
    "maps submaps": Program("quality.submaps", "recall", "recall of single scans and of submaps"),
    "sensors imu": Program("quality.sensors", "imu", "gravity of a sensor in a hand by IMU and ground"),
    "sensors deskew": Program("quality.sensors", "deskew", "scans on a fast turn before and after deskewing"),
    "sensors rotation": Program("quality.sensors", "rotation", "movement of a descriptor when the scan rotates"),
    "methods baselines": Program("quality.methods", "baselines", "methods beside each other: scores and times"),
    "realism compare": Program("quality.realism", "compare", "histograms of real and simulated scans"),
    "realism semantics": Program("quality.realism", "semantics", "semantics of real scans by simulated training"),
    "speed embed": Program("speed.embed", "embed", "from a scan's file to its descriptor"),
    "speed loops": Program("speed.loops", "loops", "memory and time of the loop detector on a long drive"),
    "speed stages": Program("speed.stages", "stages", "time of the loop search by stage"),
    "speed live": Program("speed.live", "live", "latency, dropped scans and memory of bin/live"),
    "speed start-up": Program("speed.start_up", "start_up", "time until a command starts"),
    "speed training": Program("speed.training", "training", "training steps, and their share of the device's peak"),
    "speed profile": Program("speed.profile_step", "profile", "parts of a training step"),
    "torch describe": Program("torch_peer.compare", "describe", "descriptors beside the same network in PyTorch"),
    "torch step": Program("torch_peer.compare", "step", "training steps beside PyTorch's"),
    "learned data": Program("learned.data", "data", "recordings for the comparison of learned methods"),
    "learned labels": Program("learned.data", "labels", "the same recordings with other labels"),
    "learned sampler": Program("learned.sampler", "sampler", "positives and false negatives of the training"),
    "learned train": Program("learned.train", "train", "equal trainings of the networks of other publications"),
    "learned preset": Program("learned.train", "train_preset", "the same training of a preset"),
    "learned score": Program("learned.score", "score", "scores on unseen recordings"),
    "learned cost": Program("learned.cost", "cost", "time and size of a descriptor"),
    "learned leaderboard": Program("learned.leaderboard", "leaderboard", "writes docs/leaderboard.md and its figure"),
    "fleet embed": Program("fleet.ray", "embed", "recipe for Ray: places of many recordings"),
    "fleet loops": Program("fleet.ray", "loops", "recipe for Ray: loops between recordings that may overlap"),
    "fleet places": Program("fleet.index", "places", "places for a large index"),
    "fleet index": Program("fleet.index", "index", "time, bytes and recall of a large index"),
    "robustness kills": Program("robustness.disturbed", "kills", "commands that are killed again and again"),
    "robustness disk": Program("robustness.disturbed", "disk", "full disk, read-only folder, missing files"),
    "robustness hostile": Program("robustness.hostile", "hostile", "bin/live with damaged messages, for minutes"),
    "fuzz": Program("robustness.fuzz", "fuzz", "damaged files of every format, for hours"),
    "robustness platforms": Program("robustness.platforms", "platforms", "wheels of every dependency, by platform"),
}


def program_name(words: list[str]) -> str | None:
    """Name in `PROGRAMS` that is the first two words or the first word of a command line, or None."""
    return next((name for name in (" ".join(words[:2]), *words[:1]) if name in PROGRAMS), None)


def main(words: list[str]) -> None:
    """Runs the program that a command line names, with its flags. Without a name, lists all programs."""
    name = program_name(words)
    if name is not None:
        flags = words[len(name.split()) :]
        tyro.cli(PROGRAMS[name].load(), args=flags, prog=f"python -m benchmarks {name}")
        return
    print("\n".join(f"{name:20} {program.summary}" for name, program in PROGRAMS.items()))
    if words and not words[0].startswith("-"):
        raise SystemExit(f"error: expected one of these programs, found {' '.join(words[:2])!r}")


if __name__ == "__main__":
    main(sys.argv[1:])
