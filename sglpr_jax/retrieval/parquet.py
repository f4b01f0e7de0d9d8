"""Places of a fleet as rows of Arrow tables, in Parquet files of a store. `FleetIndex` has the same columns."""

import contextlib
import hashlib
import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.fingerprint import fingerprint
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scaled import scale_of
from sglpr_jax.extras import install_command
from sglpr_jax.fields import Size
from sglpr_jax.files import file_name, in_short, naming, parse_json, replacing
from sglpr_jax.methods.method import Method
from sglpr_jax.methods.registry import network
from sglpr_jax.models.weights import Params
from sglpr_jax.retrieval.descriptor_file import DescriptorFile
from sglpr_jax.retrieval.embed import embed
from sglpr_jax.schema import check_about

if TYPE_CHECKING:
    import pyarrow

FORMAT = "sglpr-jax places 1"
"""Format in every file and index."""
ABOUT = {"width": Size, "weights_hash": str, "scale": int}
"""JSON values in the metadata `about` of every file and index. Descriptors with other values are not comparable."""
KEY = "place"
"""Column of the unique name of a place: recording/scan."""
POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
"""Columns of the pose in the frame of the recording, in metres and as a quaternion. Unknown values are null."""


def schema(about: dict[str, Any]) -> "pyarrow.Schema":
    """Return the columns of a table of places, with `about` (the values of `ABOUT`) in its metadata."""
    import pyarrow

    unique = {"lance-schema:unenforced-primary-key": "true"}  # concurrent writers add a place once
    fields = [
        pyarrow.field(KEY, pyarrow.string(), nullable=False, metadata=unique),
        *(pyarrow.field(name, pyarrow.string(), nullable=False) for name in ("recording", "scan", "site", "source")),
        *(pyarrow.field(name, pyarrow.float64()) for name in ("time", *POSE)),
        pyarrow.field("weights", pyarrow.string(), nullable=False),
        pyarrow.field("descriptor", pyarrow.list_(pyarrow.float32(), about["width"]), nullable=False),
    ]
    return pyarrow.schema(fields, metadata={"about": json.dumps({"format": FORMAT, **about})})


def place_rows(
    file: DescriptorFile,
    recording: str,
    *,
    site: str = "",
    source: str = "",
    rotations: Float[np.ndarray, "n 3 3"] | None = None,
) -> "pyarrow.Table":
    """Return the places of a descriptor file, one row a scan.

    Arguments:
      file: Descriptors that are compared by L2.
      recording: Unique name of the recording among all recordings of the fleet.
      site: Where the recording was made, for queries within one site.
      source: Address of the recording, for programs that read its scans again.
      rotations: Rotation of the LiDAR at each scan of the file, in the frame of the positions. None if unknown.

    Raises ValueError if another distance compares the descriptors.
    """
    import pyarrow
    from scipy.spatial.transform import Rotation  # imported here because the import is slow

    if file.distance != "l2":
        raise ValueError(f"expected descriptors compared by l2, found {file.distance}")
    n, width = file.descriptors.shape
    pose = dict.fromkeys(POSE, np.full(n, np.nan))
    if file.positions is not None:
        pose |= zip(POSE[:3], file.positions.T, strict=True)
        if rotations is not None:
            pose |= zip(POSE[3:], Rotation.from_matrix(rotations).as_quat().T, strict=True)
    times = np.full(n, np.nan) if file.times is None else file.times
    columns = [
        [f"{recording}/{scan}" for scan in file.ids],
        [recording] * n,
        list(file.ids),
        [site] * n,
        [source] * n,
        *(pyarrow.array(values, from_pandas=True) for values in (times, *pose.values())),  # NaN becomes null
        [file.weights_hash] * n,
        pyarrow.FixedSizeListArray.from_arrays(pyarrow.array(file.descriptors.reshape(-1)), width),
    ]
    about = {"width": width, "weights_hash": file.weights_hash, "scale": file.scale}
    return pyarrow.table(columns, schema=schema(about))


def about_of(stored: "pyarrow.Schema", source: str) -> dict[str, Any]:
    """Return the values of `ABOUT` in a table's metadata. Raises ValueError, naming `source`, if a column is missing or
    has another type."""
    about = parse_json((stored.metadata or {}).get(b"about", b"null"), source=f"{source}, `about`")
    with naming(source):
        check_about(about, ABOUT, format=FORMAT)
        about = {name: about[name] for name in ABOUT}
        stored_types = {field.name: str(field.type) for field in stored}
        for field in schema(about):
            stored_type = stored_types.get(field.name, "none")
            # Parquet and LanceDB name the elements of a list differently.
            if stored_type.replace("item:", "element:") != str(field.type).replace("item:", "element:"):
                raise ValueError(f"expected a column {field.name} of {field.type}, found {stored_type}")
    return about


@contextlib.contextmanager
def storage_errors(address: str) -> Iterator[None]:
    """Convert any exception of the block, which calls a storage library, to a ValueError that names the address. An
    ImportError stays an ImportError, and says what to install."""
    try:
        yield
    except ImportError as error:
        command = f"{install_command('fleet')}, and s3fs for s3://, gcsfs for gs://"
        raise ImportError(f"{address}: expected the extra `fleet` ({command}), found: {in_short(error)}") from error
    except Exception as error:
        reason = in_short(error, most=200)
        raise ValueError(f"{address}: expected a store that can be read and written, found: {reason}") from error


def embed_to_store(
    store: str, method: Params | Method, recording: Recording, *, site: str = "", source: str = "", **options: Any
) -> tuple[str, int | None]:
    """Describe a recording and write its places to a store, unless they are there already.

    Returns the address of the Parquet file, and the number of computed places, or None if the file existed. Reads all
    files of the recording once to compute their hash.

    Arguments:
      store: Folder, or address in object storage.
      method: Weights of a model, or another method whose descriptors are compared by L2.
      recording: Scans or images to describe.
      site: Where the recording was made.
      source: Address of the recording.
      options: Options of `embed`.

    Raises ValueError if another distance compares the descriptors, or the store cannot be read or written.

    Example:
      embed_to_store("s3://bucket/places", sglpr_jax.load("sglpr"), recording, site="berlin")
    """
    method = network(method) if isinstance(method, Params) else method
    settings = [method.weights_hash, method.about, options.get("rotation_seed"), scale_of(recording)]
    settings_hash = hashlib.sha256(json.dumps(settings).encode()).hexdigest()[:12]
    name = file_name(f"{recording.name}-{fingerprint(recording, contents='all')}")
    address = f"{store.rstrip('/')}/{file_name(method.about['method'])}-{settings_hash}/{name}.parquet"
    with storage_errors(address):
        filesystem, path = _open(address)
        if filesystem.exists(path):
            return address, None
    file = embed(method, recording, **options)
    poses = recording.world_from_lidar
    rotations = None if poses is None else poses[file.is_described][:, :3, :3]
    rows = place_rows(file, name, site=site, source=source, rotations=rotations)
    content = io.BytesIO()
    with storage_errors(address):
        import pyarrow.parquet
        from fsspec.implementations.local import LocalFileSystem

        pyarrow.parquet.write_table(rows, content)
        if isinstance(filesystem, LocalFileSystem):
            with replacing(Path(path)) as temporary:
                temporary.write_bytes(content.getbuffer())
        else:  # object storage shows only complete objects
            filesystem.pipe_file(path, content.getvalue())
    return address, len(rows)


def stored_places(store: str) -> list[str]:
    """Return the addresses of all Parquet files of a store. Raises ValueError if it cannot be read."""
    with storage_errors(store):
        filesystem, path = _open(store)
        paths = [path for path in sorted(filesystem.find(path)) if path.endswith(".parquet")]
        return [filesystem.unstrip_protocol(path) for path in paths if not path.rpartition("/")[2].startswith(".")]


def read_places(address: str) -> "pyarrow.Table":
    """Read the rows of one Parquet file. Raises ValueError if it contains other columns."""
    with storage_errors(address):
        import pyarrow.parquet

        filesystem, path = _open(address)
        rows = pyarrow.parquet.read_table(io.BytesIO(filesystem.cat_file(path)))
    about_of(rows.schema, address)
    return rows


def _open(address: str) -> tuple[Any, str]:
    """Return the file system of an address, and the path in it."""
    import fsspec

    return fsspec.core.url_to_fs(address)
