"""A reproduction of the paper: trains models, computes descriptors and scores, and keeps the results in folders."""

import functools
import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from sglpr_jax.data.choices import PoseChoice
from sglpr_jax.data.fingerprint import fingerprint
from sglpr_jax.data.readers import open_recording, recording_names
from sglpr_jax.data.recording import Recording
from sglpr_jax.evaluation.learning_curves import LearningCurves
from sglpr_jax.evaluation.protocols import PROTOCOLS
from sglpr_jax.evaluation.protocols.result import Result
from sglpr_jax.files import file_name, read_json, write_json
from sglpr_jax.methods.handcrafted import HANDCRAFTED
from sglpr_jax.methods.method import Method, Takes
from sglpr_jax.methods.registry import handcrafted, method_with_weights, network
from sglpr_jax.models.weights import Params
from sglpr_jax.models.weights_file import load
from sglpr_jax.progress import Progress, no_progress
from sglpr_jax.reproduce.experiments import EXPERIMENTS, TOP1, VARIANTS, variant_config
from sglpr_jax.retrieval.descriptor_file import DescriptorFile
from sglpr_jax.retrieval.embed import embed
from sglpr_jax.training.callbacks import Callbacks, ProgressBar
from sglpr_jax.training.config import TrainConfig
from sglpr_jax.training.recipe import LIMITS, TrainResult, run_settings, train, with_teacher
from sglpr_jax.training.run_folder import CONFIG_FILE, require_same_settings

ROTATION_SEED = 0
BATCH = 16
DONE_FILE = "trained.json"
"""File in the folder of a run with the number of steps, written at the end of training."""
WITHOUT_TRAINING = "without-training"


@functools.cache
def _opened(data: Path, seq: str, pose_source: PoseChoice) -> Recording:
    """Open a recording of a dataset once, so that its scans stay the same if files disappear later."""
    return open_recording(data, seq, pose_source=pose_source)


@dataclass(frozen=True)
class Reproduction:
    """Leave-one-out runs and the methods that they are compared with.

    `folder`/VARIANT/SEQ contains a model trained on all recordings of `data` except SEQ.
    """

    folder: Path
    data: Path
    preset: str
    config: TrainConfig
    seqs: tuple[str, ...]
    """Test recordings."""
    methods: tuple[str, ...] = ()
    """Handcrafted methods for comparison."""
    weights: tuple[str, ...] = ()
    """Weights for comparison: shipped names or folders."""
    sessions: Callable[[], Path] = Path
    """Returns the folder of sessions in NCLT's layout. Called only for experiments across sessions."""
    trained: bool = True
    """Whether variants are trained."""
    pose_source: PoseChoice = "auto"
    progress: Progress = no_progress
    """Shows the progress of embeddings."""

    def config_of(self, variant: str) -> TrainConfig:
        """Return the configuration of a variant."""
        return variant_config(self.config, variant)

    def is_trained(self, variant: str, seq: str) -> bool:
        """Return whether a run has done all steps. Raises ValueError if it has other settings or more steps."""
        folder = self._folder(variant, seq)
        if not (folder / CONFIG_FILE).is_file():  # a process that was killed early leaves a folder without a run
            return False
        config = with_teacher(self.config_of(variant))  # as `train` stores it
        require_same_settings(folder, run_settings(config, self._settings(seq)), limits=LIMITS)
        path = folder / DONE_FILE
        content = read_json(path) if path.is_file() else {"steps": 0}
        steps = content.get("steps") if isinstance(content, dict) else content
        if type(steps) is not int:
            raise ValueError(f'{path}: expected {{"steps": a number}}, found {steps!r:.60}')
        if steps > self.config.steps:
            raise ValueError(f"{folder}: expected a run of up to {self.config.steps} steps, found {steps}")
        return steps == self.config.steps

    def train(self, variant: str, seq: str, *, stopped: Callable[[], bool]) -> TrainResult:
        """Train the remaining steps, or until `stopped` is true. Raises ValueError if the run has other settings."""
        folder = self._folder(variant, seq)
        result = train(
            self.config_of(variant),
            self.recordings_but(seq),
            out=folder,
            test=self.recording(seq),
            resume=(folder / CONFIG_FILE).is_file(),
            callback=Callbacks(ProgressBar(), LearningCurves(folder)),
            stopped=stopped,
            settings=self._settings(seq),
        )
        if result.finished:
            write_json(folder / DONE_FILE, {"steps": self.config.steps})
        return result

    def params(self, variant: str, seq: str) -> Params:
        """Return the weights of a finished run."""
        return load(self._folder(variant, seq))

    def recording(self, seq: str) -> Recording:
        """Open a recording of the dataset."""
        return _opened(self.data, seq, self.pose_source)

    def recordings_but(self, seq: str) -> list[Recording]:
        """Return the training recordings of the runs that are tested on `seq`: all others of the dataset."""
        return [self.recording(name) for name in recording_names(self.data) if name != seq]

    def session_recordings(self) -> list[Recording]:
        """Open the sessions. The first is the database, the others are queries."""
        root = self.sessions()
        return [open_recording(root, session) for session in recording_names(root)]

    def labels(self, name: str) -> Mapping[str, str]:
        """Return the labels of the rows of a table or figure, by the name of the variant or other method."""
        labels = dict(EXPERIMENTS[name].variants) if self.trained else {}
        if EXPERIMENTS[name].beside_handcrafted:
            labels |= {method: method for method in (*self.weights, *self.methods)}
        return labels

    def descriptors(
        self, method: str, seq: str, *, of: Recording | None = None, rotated: bool = False
    ) -> DescriptorFile:
        """Return the descriptors of the recording `seq` or of the recording `of`, with `rotated` at random angles.

        `method` is a variant, whose model was trained without `seq`, a handcrafted method, or weights.
        """
        recording = of or self.recording(seq)
        folder = self._folder(method, seq) if method in VARIANTS else self.folder / WITHOUT_TRAINING / file_name(method)
        describer, seed = self._method(method, seq, recording), ROTATION_SEED if rotated else None
        settings = [fingerprint(recording), recording.pose_source, seed, describer.weights_hash, describer.about]
        settings_hash = hashlib.sha256(json.dumps(settings).encode()).hexdigest()[:12]
        kind = "rotated" if rotated else "raw"
        path = folder / "descriptors" / f"{file_name(recording.name)}-{kind}-{settings_hash}.npz"
        if path.exists():
            return DescriptorFile.load(path)
        with self.progress(f"embed {method} {recording.name}", len(recording)) as show:
            file = embed(describer, recording, rotation_seed=seed, batch=BATCH, on_progress=show)
        file.save(path)
        return file

    @functools.cache  # noqa: B019  a process has one reproduction
    def score(self, method: str, seq: str, protocol: str = TOP1, *, rotated: bool = False) -> Result:
        """Return the result of a variant, a handcrafted method or weights on the recording `seq` by a protocol."""
        return PROTOCOLS[protocol](self.descriptors(method, seq, rotated=rotated))

    def _method(self, method: str, seq: str, recording: Recording) -> Method:
        """Return the method that describes the scans of `recording`, given the name of a variant, method or weights."""
        if method in VARIANTS:
            return network(self.params(method, seq))
        if method in HANDCRAFTED:
            return handcrafted(method, None if recording.has_images else self.config.model.grid)
        return method_with_weights(method)

    def _settings(self, seq: str) -> dict[str, str]:
        """Return the settings of a run that its configuration does not have. A resumed run must have the same."""
        return {"seq": seq, "data": str(self.data), "preset": self.preset, "pose_source": self.pose_source}

    def _folder(self, variant: str, seq: str) -> Path:
        return self.folder / variant / file_name(seq)


def content_of(method: str) -> Takes:
    """Return what a method needs in a recording. `method` is a handcrafted method, or the name or folder of weights."""
    return HANDCRAFTED[method].takes if method in HANDCRAFTED else method_with_weights(method).takes
