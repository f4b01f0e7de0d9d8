"""Parquet files of places, one for each recording, in a folder or in object storage (`s3://`, `gs://`).

The name of a file contains a hash of the recording, and its folder a hash of the method and the weights. If the file
exists, the descriptors are not computed again. A file appears when it is complete.
"""

import hashlib
import io
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scaled import scale_of
from sglpr_jax.files import replacing
from sglpr_jax.methods.method import Method
from sglpr_jax.methods.registry import network
from sglpr_jax.models.params import Params
from sglpr_jax.names import file_name
from sglpr_jax.retrieval.descriptor_file import DescriptorFile
from sglpr_jax.retrieval.embed import embed
from sglpr_jax.retrieval.place_rows import about_of, place_rows, usable
from sglpr_jax.retrieval.reuse import fingerprint

if TYPE_CHECKING:
    import pyarrow


class Stored(NamedTuple):
    """Result of `embed_to_store`."""

    address: str
    """Address of the Parquet file."""
    added: int | None
    """Number of places that were computed, or None if the file existed."""


def embed_to_store(
    store: str, method: Params | Method, recording: Recording, *, site: str = "", source: str = "", **options: Any
) -> Stored:
    """Describe a recording and write its places to a store, unless they are there already.

    Reads all files of the recording once to compute their hash.

    Arguments:
      store: Folder, or address in object storage.
      method: Weights of a model, or another method whose descriptors are compared by L2.
      recording: Scans or images to describe.
      site: Where the recording was made.
      source: Address of the recording.
      options: Options of `embed`.

    Raises:
      ValueError: If another distance compares the descriptors, or the store cannot be read or written.

    Example:
      embed_to_store("s3://bucket/places", sglpr_jax.load("sglpr"), recording, site="berlin")
    """
    method = network(method) if isinstance(method, Params) else method
    made = [method.weights_hash, method.about, options.get("rotation_seed"), scale_of(recording)]
    hashed = hashlib.sha256(json.dumps(made).encode()).hexdigest()[:12]
    name = file_name(f"{recording.name}-{fingerprint(recording, contents=True)}")
    folder = f"{store.rstrip('/')}/{file_name(method.about['method'])}-{hashed}"
    address = f"{folder}/{name}.parquet"
    if _exists(address):
        return Stored(address, None)
    file = embed(method, recording, **options)
    rows = place_rows(file, name, site=site, source=source, rotations=_rotations(file, recording))
    _put(address, rows)
    return Stored(address, len(rows))


def stored_places(store: str) -> list[str]:
    """Return the addresses of all Parquet files of a store. Raises ValueError if it cannot be read."""
    with usable(store):
        filesystem, path = _open(store)
        return [filesystem.unstrip_protocol(found) for found in sorted(filesystem.find(path)) if _is_places(found)]


def read_places(address: str) -> "pyarrow.Table":
    """Read the rows of one Parquet file. Raises ValueError if it contains other columns."""
    with usable(address):
        import pyarrow.parquet

        filesystem, path = _open(address)
        rows = pyarrow.parquet.read_table(io.BytesIO(filesystem.cat_file(path)))
    about_of(rows.schema, address)
    return rows


def _is_places(path: str) -> bool:
    return path.endswith(".parquet") and not path.rpartition("/")[2].startswith(".")


def _exists(address: str) -> bool:
    with usable(address):
        filesystem, path = _open(address)
        return filesystem.exists(path)


def _put(address: str, rows: "pyarrow.Table") -> None:
    """Write a Parquet file. In object storage, an object appears when it is complete."""
    content = io.BytesIO()
    with usable(address):
        import pyarrow.parquet
        from fsspec.implementations.local import LocalFileSystem

        pyarrow.parquet.write_table(rows, content)
        filesystem, path = _open(address)
        if isinstance(filesystem, LocalFileSystem):
            with replacing(Path(path)) as temporary:
                temporary.write_bytes(content.getbuffer())
        else:
            filesystem.pipe_file(path, content.getvalue())


def _open(address: str) -> tuple[Any, str]:
    """Return the file system of an address, and the path in it."""
    import fsspec

    return fsspec.core.url_to_fs(address)


def _rotations(file: DescriptorFile, recording: Recording) -> Float[np.ndarray, "n 3 3"] | None:
    """Rotations of the described scans, if the recording has poses with rotations."""
    return None if recording.world_from_lidar is None else recording.world_from_lidar[file.recorded][:, :3, :3]
