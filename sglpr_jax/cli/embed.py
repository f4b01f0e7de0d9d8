"""bin/embed: write the descriptors of a sequence or of a folder of scans."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from sglpr_jax.cli.recording import (
    OdometrySubmapOptions,
    PosedRecordingOptions,
    beside,
    report_bad_scan,
    resolved_scale,
)
from sglpr_jax.data.choices import ScaleChoice
from sglpr_jax.fields import CountOrZero, Size
from sglpr_jax.methods.names import NETWORK, AnyMethodName
from sglpr_jax.progress import progress_bar

if TYPE_CHECKING:
    from sglpr_jax.methods.method import Method
    from sglpr_jax.models.weights import Params


@dataclasses.dataclass(frozen=True)
class EmbedCommand:
    """Write one descriptor per scan, with ids, and with positions and times if available.

    Example:
      bin/embed --weights runs/sglpr-08 --data KITTI --seq 08 --out 08.npz
      bin/embed --data my_scans/ --skip-bad
      bin/embed --data my_scans/ --poses odometry.tum --out mine.npz
      bin/embed --data my_scans/ --submap-m 10 --odometry odometry.tum --out mine.npz
      bin/embed --method scan-context --data KITTI --seq 08 --out scan-context.npz
      bin/embed --method rinet --weights runs/rinet/weights-8000 --data KITTI --seq 08 --out rinet.npz
      bin/embed --data KITTI --seq 08 --corruption occlusion-90 --out 08-occlusion-90.npz
      bin/embed --data my_scans/ --site berlin --out s3://bucket/places
    """

    data: Path
    """A dataset, a bag or a folder of scans or ready-made images, in any supported layout."""
    out: str | None = None
    """Descriptor file to write (.npz), or a store of places (extra `fleet`): an address such as s3://bucket/places, or
    a folder with a / at the end. A store gets a Parquet file for each recording, unless it is there already. None:
    NAME.npz beside --data NAME."""
    weights: str | None = None
    """Name of shipped weights, folder of a training run, or folder with config.json and model.safetensors. None: the
    shipped weights sglpr. Learned methods need the folder of their training, or random:SEED for a network without
    training."""
    method: AnyMethodName = "sglpr"
    """The network, a handcrafted method, which needs no weights, or a learned method of another publication. Some
    methods need points; ssc and rinet also need labels."""
    source: tyro.conf.OmitArgPrefixes[PosedRecordingOptions] = PosedRecordingOptions()
    submap: tyro.conf.OmitArgPrefixes[OdometrySubmapOptions] = OdometrySubmapOptions()
    scale: ScaleChoice = 1
    """Factor for all lengths before scans are described. 2 or 4 enlarges places that are small in an image, such as
    rooms. `auto` is 4 if nine tenths of the points are less than 8 m away, otherwise 1."""
    rotate: bool = False
    """Rotate every scan about z by its own random angle."""
    corruption: str | None = None
    """Corrupt every scan for a stress test: occlusion-DEGREES, beams-NUMBER, noise-METRES, dropout-SHARE,
    offset-METRES, or rotation (as --rotate)."""
    seed: CountOrZero = 0
    """Seed of --rotate and --corruption. The seed and the scan's number determine the corruption of a scan."""
    skip_bad: bool = False
    """Report unreadable scans and skip them."""
    site: str = ""
    """Where the recording was made: column `site` of a store."""
    batch: Size = 8
    """Maximum number of images that are described at a time."""

    @property
    def target(self) -> str:
        """Descriptor file or store to write."""
        return self.out or str(beside(self.data, self.source.seq, ".npz"))


def embed_recording(command: EmbedCommand) -> None:
    from sglpr_jax.data.corruption import ROTATION, corrupted, corruption_named  # slow imports, not needed for --help
    from sglpr_jax.data.scaled import scaled
    from sglpr_jax.methods.registry import method_named
    from sglpr_jax.retrieval.embed import embed
    from sglpr_jax.retrieval.parquet import embed_to_store

    corruption = None if command.corruption is None else corruption_named(command.corruption)
    writes_store = "://" in command.target or command.target.endswith("/")
    if not writes_store:
        _check_file(command)
    elif corruption is not None:
        raise ValueError(f"{command.target}: expected a descriptor file with --corruption, found a store")
    learned_method, params = _load_weights(command)
    recording = command.submap.open(command.source, command.data)
    if corruption not in (None, ROTATION):
        recording = corrupted(recording, corruption, seed=command.seed)
    recording = scaled(recording, resolved_scale(command.scale, recording))
    method = learned_method or method_named(command.method, params, ready_made=recording.has_images)
    with progress_bar(f"embed {recording.name}", len(recording)) as show:
        options = {
            "rotation_seed": command.seed if command.rotate or corruption == ROTATION else None,
            "batch": command.batch,
            "on_bad_scan": report_bad_scan if command.skip_bad else None,
            "on_progress": show,
        }
        if writes_store:
            origin = {"site": command.site, "source": str(command.data.absolute())}
            address, added = embed_to_store(command.target, method, recording, **origin, **options)
        else:
            file = embed(method, recording, **options)
    if writes_store:
        print(f"{address}: {'already there' if added is None else f'{added} places'}")
        return
    file.save(Path(command.target))
    skipped = len(recording) - len(file)
    print(f"{command.target}: {len(file)} descriptors of {file.descriptors.shape[1]} numbers, {skipped} scans skipped")


def _load_weights(command: EmbedCommand) -> "tuple[Method | None, Params | None]":
    """Load --weights. Returns (method, None) for a learned method, (None, parameters) for the network of this package,
    and (None, None) without --weights. Raises ValueError if --weights do not fit --method."""
    from sglpr_jax.methods.learned import LEARNED
    from sglpr_jax.methods.registry import trained_method
    from sglpr_jax.models.weights_file import load

    if command.method in LEARNED:
        if command.weights is None:
            raise ValueError(
                f"{command.method}: expected --weights with a folder of bin/peers train, or random:0 for an untrained "
                "network, found none"
            )
        return trained_method(LEARNED[command.method], command.weights), None
    if command.weights is None:
        return None, None
    if command.method != NETWORK:
        raise ValueError(
            f"{command.weights}: expected --method sglpr or one of bin/peers with --weights, found {command.method}"
        )
    return None, load(command.weights)


def _check_file(command: EmbedCommand) -> None:
    """Raise ValueError or OSError before long work if the descriptor file cannot be written."""
    from sglpr_jax.files import check_writable

    out = Path(command.target)
    if out.suffix != ".npz":
        raise ValueError(f"expected --out to end in .npz or /, or an address such as s3://bucket/places, found {out}")
    if command.site:
        raise ValueError(f"{out}: expected --site only with a store, found a descriptor file")
    if not out.parent.is_dir():
        raise FileNotFoundError(f"{out}: its folder {out.parent} does not exist")
    check_writable(out)
