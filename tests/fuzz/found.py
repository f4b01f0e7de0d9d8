"""What the fuzzer has found, kept: damaged files that once were read wrongly or ended in a traceback."""

import io
import json
import zipfile
import zlib

import numpy as np

from sglpr_jax.retrieval.reuse import SETTINGS

from .archives import DESCRIPTOR_FILE, arrays_of, npz
from .continued import MADE_WITH
from .damage import Damaged, safetensors_file, safetensors_parts
from .roads import FILE_ROADS
from .scans_and_images import PCD_BINARY


def _replaced(road: str, old: bytes, new: bytes) -> Damaged:
    whole = FILE_ROADS[road].whole
    assert old in whole, (road, old)
    return Damaged(whole.replace(old, new, 1))


def _with_number(road: str, *, at: int, number: int) -> Damaged:
    """Another size in a binary header."""
    whole = FILE_ROADS[road].whole
    return Damaged(whole[:at] + number.to_bytes(4, "little") + whole[at + 4 :])


def _member_that_is_no_array() -> Damaged:
    """numpy gives it as bytes."""
    stream = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(DESCRIPTOR_FILE)) as whole, zipfile.ZipFile(stream, "w") as damaged:
        for name in whole.namelist():
            damaged.writestr(name, b"no array" if name == "descriptors.npy" else whole.read(name))
    return Damaged(stream.getvalue())


def _picture_that_promises_more(road: str, height: int) -> Damaged:
    """Pillow filled the missing rows with whatever was in memory."""
    whole = FILE_ROADS[road].whole
    header = whole[12:20] + height.to_bytes(4, "big") + whole[24:29]
    return Damaged(whole[:12] + header + zlib.crc32(header).to_bytes(4, "big") + whole[33:])


def _checksum_without_its_name() -> Damaged:
    header, body = safetensors_parts(FILE_ROADS["weights"].whole)
    header["__metadata__"] = {"shA256": header["__metadata__"]["sha256"]}
    return Damaged(safetensors_file(header, bytes([body[0] ^ 1]) + body[1:]))


def _made_with(settings: object) -> Damaged:
    """A descriptor file that claims other settings."""
    arrays = arrays_of(FILE_ROADS["stress test"].whole)
    about = json.loads(str(arrays["about"]))
    about["config"][SETTINGS] = settings
    return Damaged(npz({**arrays, "about": np.array(json.dumps(about))}))


def _configuration(**changes: object) -> Damaged:
    return Damaged(json.dumps({**json.loads(FILE_ROADS["configuration"].whole), **changes}).encode())


FOUND = (
    ("matrix", _replaced("matrix", b"(5, 4)", b"(5, 4+")),
    ("matrix", _replaced("matrix", b"(5, 4)", b"(55555555555555, 4)")),
    ("descriptor file", _member_that_is_no_array()),
    ("scored pairs", _replaced("scored pairs", b"0.5", b"1_0")),
    ("KITTI poses", _replaced("KITTI poses", b"1 0 0", "１ 0 0".encode())),
    ("csv poses", _replaced("csv poses", b"0.5", b"1_0")),
    ("NCLT ground truth", _replaced("NCLT ground truth", b"1326652795280148", b"1e30")),
    ("metrics", _replaced("metrics", b'{"step": 2', b'"step": 2')),
    ("configuration", _configuration(backbone={"kind": ["swin"]})),
    ("configuration", _configuration(image="Density")),
    ("configuration", _configuration(blind_m=float("nan"))),
    ("configuration", Damaged(b"[" * 100_000)),
    ("loops, JSON lines", _replaced("loops, JSON lines", b"0.98006", b"1e300")),
    ("weights", _checksum_without_its_name()),
    ("image", _picture_that_promises_more("image", 6000)),
    ("image", _picture_that_promises_more("image", 2**31 - 1)),
    ("label image", _picture_that_promises_more("label image", 7)),
    ("labels", Damaged(b"\x4d\0\0\0" * 5)),
    ("scan .pcd, binary", Damaged(PCD_BINARY.replace(b"COUNT 1", b"COUNT 0", 1))),
    ("scan .pcd, binary", _replaced("scan .pcd, binary", b"COUNT 1 1 1 1", b"COUNT 1 1 1 99999999999999999999")),
    ("scan .pcd, binary", _replaced("scan .pcd, binary", b"TYPE F", b"TYPE ,F")),
    ("scan .pcd, binary", Damaged(PCD_BINARY.replace(b"SIZE 4", b"SIZE 8").replace(b"TYPE F", b"TYPE C"))),
    ("scan .pcd, ascii", Damaged(FILE_ROADS["scan .pcd, ascii"].whole.rstrip().rpartition(b" ")[0] + b" 1_0\n")),
    ("scan .pcd, binary", _replaced("scan .pcd, binary", b"COUNT 1", b"COUNT01")),
    ("loops, JSON lines", _replaced("loops, JSON lines", b"0.9375", b"1" + b"0" * 30)),
    ("stress test", _made_with([])),
    ("stress test", _made_with({**MADE_WITH, "seed_": None})),
    ("g2o", _replaced("g2o", FILE_ROADS["g2o"].whole.split()[8], b"1e300")),
    ("TUM poses", _replaced("TUM poses", b" 1\n", b" 1e300\n")),
    ("scan .ply, little", _replaced("scan .ply, little", b"property float int", b"propesty float int")),
    ("scan .ply, little", Damaged(FILE_ROADS["scan .ply, little"].whole + b"\0")),
    ("scan .ply, ascii", _replaced("scan .ply, ascii", b"vertex 5", b"vertex 4")),
    ("scan .npy", _replaced("scan .npy", b"(5, 4), }      ", b"(2147483647, 4)")),
    ("scan .las", _with_number("scan .las", at=100, number=2**32 - 1)),
    ("bag .mcap", Damaged(FILE_ROADS["bag .mcap"].whole.replace(b"uint32 height", b"uint32 heighv"))),
    ("bag .bag", _replaced("bag .bag", b"uint32 height", b"uint32 \n\neight")),
    ("scan .pcd, binary", Damaged(PCD_BINARY.replace(b"POINTS 5", b"POINTS 1", 1))),
)
"""The road, and the file."""
