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
    "loops simulated": Program("quality.loops", "simulated", "loops of simulated drives, ours and other methods'"),
    "loops images": Program("quality.loops", "images", "loops of ready-made images, and F1max after verification"),
    "repeating render": Program("quality.repeating", "render", "renders drives where places repeat"),
    "repeating search": Program("quality.repeating", "search", "wrong loops and recall in rendered drives"),
    "repeating evidence": Program("quality.missing_evidence", "evidence", "the right place beside the best lookalike"),
    "repeating fit": Program("quality.fit_loops", "fit_model", "fits and writes loops/probability.json"),
    "sessions render": Program("quality.sessions", "render", "renders pairs of drives through one town"),
    "sessions search": Program("quality.sessions", "search", "transforms between them, and invented ones"),
    "poses pairs": Program("quality.poses", "pairs", "errors of pairs of revisits against their covariances"),
    "poses search": Program("quality.poses", "search", "roll, pitch and height of loops of whole drives"),
    "maps cloud": Program("quality.maps", "cloud", "relocalisation in a point cloud map"),
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
    "speed live": Program("speed.live", "live", "latency, dropped scans and memory of bin/live"),
    "speed start-up": Program("speed.start_up", "start_up", "time until a command starts"),
    "speed index": Program("speed.index", "index", "a query among a million places beside faiss"),
    "speed training": Program("speed.training", "training", "training steps, and their share of the device's peak"),
    "speed profile": Program("speed.profile_step", "profile", "parts of a training step"),
    "torch describe": Program("torch_peer.compare", "describe", "descriptors beside the same network in PyTorch"),
    "torch step": Program("torch_peer.compare", "step", "training steps beside PyTorch's"),
    "learned data": Program("learned.data", "data", "recordings for the comparison of learned methods"),
    "learned labels": Program("learned.data", "labels", "the same recordings with other labels"),
    "learned train": Program("learned.train", "train", "equal trainings of the networks of other publications"),
    "learned preset": Program("learned.train", "train_preset", "the same training of a preset"),
    "learned score": Program("learned.score", "score", "scores on unseen recordings"),
    "learned cost": Program("learned.cost", "cost", "time, size and operations of a descriptor"),
    "learned leaderboard": Program("learned.leaderboard", "leaderboard", "writes docs/leaderboard.md and its figure"),
    "fleet embed": Program("fleet.ray", "embed", "recipe for Ray: places of many recordings"),
    "fleet loops": Program("fleet.ray", "loops", "recipe for Ray: loops between recordings that may overlap"),
    "fleet places": Program("fleet.index", "places", "places for a large index"),
    "fleet index": Program("fleet.index", "index", "time, bytes and recall of a large index"),
    "robustness kills": Program("robustness.disturbed", "kills", "commands that are killed again and again"),
    "robustness together": Program("robustness.disturbed", "together", "commands started twice at once on one folder"),
    "robustness disk": Program("robustness.disturbed", "disk", "full disk, read-only folder, missing files"),
    "robustness mutations": Program("robustness.mutations", "mutations", "wrong lines, and whether tests notice them"),
    "robustness platforms": Program("robustness.platforms", "platforms", "wheels of every dependency, by platform"),
}


def main(arguments: list[str]) -> None:
    """Run the program that the first words name."""
    for words in (2, 1):
        name = " ".join(arguments[:words])
        if name in PROGRAMS:
            tyro.cli(PROGRAMS[name].load(), args=arguments[words:], prog=f"python -m benchmarks {name}")
            return
    print("\n".join(f"{name:20} {one.summary}" for name, one in PROGRAMS.items()))
    if arguments and not arguments[0].startswith("-"):
        raise SystemExit(f"error: expected one of these programs, found {' '.join(arguments[:2])!r}")


if __name__ == "__main__":
    main(sys.argv[1:])
