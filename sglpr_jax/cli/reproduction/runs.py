"""The trained models and descriptors behind the tables: made where they are missing, kept in one folder per run."""

import json
import statistics
from dataclasses import dataclass
from pathlib import Path

from sglpr_jax.cli.methods import Method, network, reference
from sglpr_jax.cli.reproduction.experiments import variant_config
from sglpr_jax.cli.runtime import progress_bar, write_json
from sglpr_jax.cli.train import TrainCommand, require_same_settings, train_only
from sglpr_jax.data import Drive, open_sequence, sequence_names
from sglpr_jax.data.kitti import PoseChoice
from sglpr_jax.models.params import load
from sglpr_jax.models.sglpr import Params
from sglpr_jax.retrieval.descriptor_file import DescriptorFile
from sglpr_jax.train.config import TrainConfig
from sglpr_jax.train.loop import METRICS_FILE
from sglpr_jax.train.metrics_log import read_metrics

ROTATION_SEED = 0
DONE_FILE = "trained.json"
BASELINE_FOLDER = "without-training"


@dataclass(frozen=True)
class Runs:
    """Leave-one-out runs: `folder`/VARIANT/SEQ has one model, trained on all drives of `data` but SEQ."""

    folder: Path
    data: Path
    preset: str
    config: TrainConfig
    poses: PoseChoice = "auto"

    def is_trained(self, variant: str, seq: str) -> bool:
        """Whether nothing is left to train of a run. Raises ValueError where it was made with other settings."""
        folder = self._run(variant, seq)
        if not folder.exists():
            return False
        require_same_settings(folder, self.command(variant, seq))
        done = folder / DONE_FILE
        steps = json.loads(done.read_text())["steps"] if done.is_file() else 0
        if steps > self.config.steps:
            raise ValueError(f"{folder}: expected a run of up to {self.config.steps} steps, found {steps}")
        return steps == self.config.steps

    def train(self, variant: str, seq: str) -> None:
        """Train what is missing of a run. Raises ValueError where it was begun with other settings."""
        command = self.command(variant, seq)
        train_only(command)
        write_json(self._run(variant, seq) / DONE_FILE, {"steps": command.config.steps})

    def params(self, variant: str, seq: str) -> Params:
        """The weights of a finished run."""
        return load(self._run(variant, seq))

    def drive(self, seq: str) -> Drive:
        """A drive of the dataset."""
        return open_sequence(self.data, seq, poses=self.poses)

    def drives_but(self, seq: str) -> list[Drive]:
        """The drives that the runs for `seq` train on."""
        return [self.drive(name) for name in sequence_names(self.data) if name != seq]

    def descriptors(self, variant: str, seq: str, *, rotated: bool) -> DescriptorFile:
        """What a finished run says of the drive it has not seen."""
        path = self._run(variant, seq) / f"{_title(rotated)}.npz"
        return embedded(path, network(self.params(variant, seq)), self.drive(seq), rotated=rotated)

    def baseline(self, name: str, seq: str, *, rotated: bool) -> DescriptorFile:
        """What a method without training says of a drive."""
        path = self.folder / BASELINE_FOLDER / seq / f"{name}-{_title(rotated)}.npz"
        path.parent.mkdir(parents=True, exist_ok=True)
        drive = self.drive(seq)
        return embedded(path, reference(name, drive, self.config.model.grid), drive, rotated=rotated)

    def seconds_per_step(self) -> float | None:
        """The median over what is there already of how long a step takes; None where nothing is."""
        logs = [read_metrics(path) for path in self.folder.glob(f"*/*/{METRICS_FILE}")]
        rates = [line["steps_per_second"] for log in logs for line in log[1:] if "steps_per_second" in line]
        return 1 / statistics.median(rates) if rates else None

    def command(self, variant: str, seq: str) -> TrainCommand:
        """What bin/train would be told; it goes on with what is there."""
        folder = self._run(variant, seq)
        config = variant_config(self.config, variant)
        return TrainCommand(
            seq=seq,
            data=self.data,
            preset=self.preset,
            out=folder,
            resume=folder.exists(),
            poses=self.poses,
            config=config,
        )

    def _run(self, variant: str, seq: str) -> Path:
        return self.folder / variant / seq


def embedded(path: Path, method: Method, drive: Drive, *, rotated: bool) -> DescriptorFile:
    """Describe a drive, or read what the same method has said of it before."""
    seed = ROTATION_SEED if rotated else None
    if path.exists():
        file = DescriptorFile.load(path)
        if _was_made_by(file, method, drive, seed):
            return file
    with progress_bar(f"embed {drive.name} {path.stem}", len(drive)) as show:
        file = method.embed(drive, rotation_seed=seed, on_progress=show)
    file.save(path)
    return file


def _was_made_by(file: DescriptorFile, method: Method, drive: Drive, rotation_seed: int | None) -> bool:
    config = {"data": drive.name, **method.about, "rotation_seed": rotation_seed}
    same_weights = file.weights_hash == getattr(method, "weights_hash", "")
    return same_weights and file.ids == drive.ids and file.config == json.loads(json.dumps(config))


def _title(rotated: bool) -> str:
    return "rotated" if rotated else "raw"
