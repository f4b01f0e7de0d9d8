"""The trained models and descriptors behind the tables: made where they are missing, kept in one folder per run."""

import json
from dataclasses import dataclass
from pathlib import Path

from sglpr_jax.cli.descriptor_files import embed_or_reuse
from sglpr_jax.cli.methods import network, reference
from sglpr_jax.cli.reproduction.experiments import VARIANTS, variant_config
from sglpr_jax.cli.runtime import write_json
from sglpr_jax.cli.train import TrainCommand, require_same_settings, train_only
from sglpr_jax.data import Drive, open_sequence, sequence_names
from sglpr_jax.data.disturbances import CLEAN, ROTATION
from sglpr_jax.data.kitti import PoseChoice
from sglpr_jax.models.params import load
from sglpr_jax.models.sglpr import Params
from sglpr_jax.retrieval.descriptor_file import DescriptorFile
from sglpr_jax.train.config import TrainConfig

ROTATION_SEED = 0
BATCH = 16
DONE_FILE = "trained.json"
WITHOUT_TRAINING = "without-training"


@dataclass(frozen=True)
class Runs:
    """Leave-one-out runs: `folder`/VARIANT/SEQ has one model, trained on all drives of `data` but SEQ."""

    folder: Path
    data: Path
    preset: str
    config: TrainConfig
    poses: PoseChoice = "auto"

    def command(self, variant: str, seq: str) -> TrainCommand:
        """What bin/train would be told; it goes on with what is there."""
        folder = self._folder(variant, seq)
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

    def is_trained(self, variant: str, seq: str) -> bool:
        """Whether nothing is left to train of a run. Raises ValueError where it was made with other settings."""
        folder = self._folder(variant, seq)
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
        train_only(self.command(variant, seq))
        write_json(self._folder(variant, seq) / DONE_FILE, {"steps": self.config.steps})

    def params(self, variant: str, seq: str) -> Params:
        """The weights of a finished run."""
        return load(self._folder(variant, seq))

    def drive(self, seq: str) -> Drive:
        """A drive of the dataset."""
        return open_sequence(self.data, seq, poses=self.poses)

    def drives_but(self, seq: str) -> list[Drive]:
        """The drives that the runs for `seq` train on."""
        return [self.drive(name) for name in sequence_names(self.data) if name != seq]

    def descriptors(self, method: str, seq: str, *, of: Drive | None = None, rotated: bool = False) -> DescriptorFile:
        """What a method says of the drive `seq`, or `of` another; a variant's model was trained without `seq`."""
        drive = of or self.drive(seq)
        folder = self._folder(method, seq) if method in VARIANTS else self.folder / WITHOUT_TRAINING / method
        (folder / "descriptors").mkdir(parents=True, exist_ok=True)
        disturbance = ROTATION if rotated else CLEAN
        described_by = network(self.params(method, seq)) if method in VARIANTS else self._reference(method, drive)
        return embed_or_reuse(
            folder / "descriptors" / f"{drive.name}-{disturbance.name}.npz",
            described_by,
            drive,
            disturbance,
            seed=ROTATION_SEED,
            batch=BATCH,
            title=f"embed {method} {drive.name}",
        )

    def _reference(self, method: str, drive: Drive):
        return reference(method, drive, self.config.model.grid)

    def _folder(self, variant: str, seq: str) -> Path:
        return self.folder / variant / seq
