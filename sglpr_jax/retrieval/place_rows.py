"""Rows of the places of a fleet, as Arrow tables. Parquet files and the index have the same columns."""

import contextlib
import json
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from sglpr_jax.fields import Size
from sglpr_jax.files import in_short, naming, parse_json
from sglpr_jax.retrieval.descriptor_file import DescriptorFile
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
    """Return the columns of places that were made as `about` states."""
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

    Raises:
      ValueError: If another distance compares the descriptors.
    """
    import pyarrow

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


def about_of(found: "pyarrow.Schema", source: str) -> dict[str, Any]:
    """Return how the places of a table were made. Raises ValueError, naming `source`, if its columns are others."""
    about = parse_json((found.metadata or {}).get(b"about", b"null"), source=f"{source}, `about`")
    with naming(source):
        check_about(about, ABOUT, format=FORMAT)
        about = {name: about[name] for name in ABOUT}
        columns = {field.name: str(field.type) for field in found}
        for field in schema(about):
            kind = columns.get(field.name, "none").replace("item:", "element:")
            if kind != str(field.type).replace("item:", "element:"):
                raise ValueError(
                    f"expected a column {field.name} of {field.type}, found {columns.get(field.name, 'none')}"
                )
    return about


def check_made_alike(expected: dict[str, Any], found: dict[str, Any], source: str) -> None:
    """Raise ValueError, naming the table `source`, if the places of other weights would be compared with its own."""
    for name, value in found.items():
        if value != expected[name]:
            here, there = (str(one)[:12] or "(none)" for one in (expected[name], value))
            raise ValueError(
                f"{source}: expected places with {name} {here}, found {there}: their descriptors are not comparable"
            )


@contextlib.contextmanager
def usable(address: str) -> Iterator[None]:
    """Convert the exceptions of storage libraries, of many types, to a ValueError that names the address."""
    try:
        yield
    except ImportError as error:
        more = "pip install 'sglpr-jax[fleet]', and s3fs for s3://, gcsfs for gs://"
        raise ImportError(f"{address}: expected the extra `fleet` ({more}), found: {in_short(error)}") from error
    except Exception as error:
        found = in_short(error, most=200)
        raise ValueError(f"{address}: expected a store that can be read and written, found: {found}") from error
