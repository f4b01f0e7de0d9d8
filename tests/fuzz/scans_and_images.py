"""Scans, ready-made images, and the labels of both."""

import functools
import io
import struct
import zlib
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
from PIL import Image

from sglpr_jax.data.formats.png import read_grey_png, read_label_image
from sglpr_jax.data.formats.scan_files import read_scan
from sglpr_jax.data.recording import scan_record
from sglpr_jax.labels import to_classes

from .damage import (
    BYTES,
    Damage,
    Damaged,
    drop_word,
)
from .road import DRAWN, N, Road, as_whole
from .rows import rows_text

GREY = DRAWN.integers(0, 255, (6, 8)).astype(np.uint8)
RAW = DRAWN.choice([0, 1, 10, 40, 50, 252], (6, 8)).astype(np.uint16)
LABELS = DRAWN.choice([0, 10, 40, 50 | 7 << 16], N).astype("<u4")
POINTS = DRAWN.normal(scale=9, size=(N, 4)).astype("<f4")


def png(image: Image.Image) -> bytes:
    stream = io.BytesIO()
    image.save(stream, "PNG")
    return stream.getvalue()


def other_picture(content: bytes, draw: Random) -> Damaged:
    """An image of another kind."""
    mode = Image.open(io.BytesIO(content)).mode
    kinds = ("1", "L", "P", "LA", "RGB", "RGBA", "I;16")
    return Damaged(png(Image.new(draw.choice([kind for kind in kinds if kind != mode]), (8, 6))))


def promise_size(content: bytes, draw: Random) -> Damaged:
    """A header that promises a picture of another size, checksum and all."""
    width, height = draw.choice(((1, 1), (0, 6), (8, 7), (8, 6000), (30000, 30000), (2**31 - 1, 2**31 - 1)))
    header = b"IHDR" + struct.pack(">II", width, height) + content[24:29]
    return Damaged(content[:12] + header + struct.pack(">I", zlib.crc32(header)) + content[33:], "either")


def other_labels(content: bytes, draw: Random) -> Damaged:
    """Ids that do not exist, or a label too many or too few."""
    labels = np.frombuffer(content, "<u4").copy()
    labels[draw.randrange(N)] = draw.choice((2, 77, 260, 65535))
    return Damaged(draw.choice((labels.tobytes(), content[:-4], content + content[:4], content[:-1])))


def odd_size(content: bytes, draw: Random) -> Damaged:
    """No whole number of points."""
    return Damaged(
        content[: -draw.randint(1, 15)] if draw.random() < 0.5 else content + draw.randbytes(draw.randint(1, 15))
    )


def _same_labels(found: np.ndarray, content: bytes) -> bool:
    return len(content) == 4 * N and np.array_equal(
        found, to_classes((np.frombuffer(content, "<u4") & 0xFFFF).astype(np.int32))
    )


def _same_points(found: np.ndarray, content: bytes) -> bool:
    points = np.frombuffer(content, "<f4").reshape(-1, 4)[:, :3]
    return len(content) > 0 and np.array_equal(found, points, equal_nan=True)


PCD_HEADER = (
    "VERSION .7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\n"
    f"WIDTH {N}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {N}\nDATA "
).encode()
PCD_BINARY = PCD_HEADER + b"binary\n" + POINTS.tobytes()
PCD_ASCII = PCD_HEADER + b"ascii\n" + rows_text(POINTS)
PCD_COUNTED = (b"FIELDS", b"SIZE", b"TYPE", b"POINTS")
COUNTS, FIELDS = b"COUNT 1 1 1 1", b"FIELDS x y z intensity"
SKIP = PCD_HEADER.count(b"\n") + 1


def change_pcd_header(content: bytes, draw: Random) -> Damaged:
    """A header that promises something else, or nothing that can be."""
    changes = (
        (b"FIELDS x y z", b"FIELDS x y w"),
        (b"FIELDS x", b"FIELDS y"),
        (b"SIZE 4", b"SIZE 3"),
        (b"SIZE 4", b"SIZE -4"),
        (b"SIZE 4", b"SIZE 8"),
        (b"TYPE F", b"TYPE Q"),
        (b"TYPE F F F F", b"TYPE F F F"),
        (b"COUNT 1", b"COUNT x"),
        (b"COUNT 1", b"COUNT 0"),
        (b"COUNT 1 1 1 1", b"COUNT 1 1 1 -1"),
        (b"POINTS 5", b"POINTS 6"),
        (b"POINTS 5", b"POINTS 0"),
        (b"POINTS 5", b"POINTS -5"),
        (b"POINTS 5", b"POINTS x"),
        (b"POINTS 5", b"POINTS"),
        (b"POINTS 5", b"POINTS 99999999999999999999"),
        (b"DATA", b"DATA binary_compressed #"),
        (b"DATA ", b"DATU "),
        (b"FIELDS", b""),
        (b"DATA", b"#DATA"),
    )
    return Damaged(content.replace(*draw.choice(changes), 1), "either")


def _same_pcd(found: np.ndarray, content: bytes) -> bool:
    """With the lines that count whole, what stands below them; else nothing but the whole file's points."""
    header, _, body = content.partition(b"DATA ")
    lines = header.split(b"\n")
    counted = [line for line in PCD_HEADER.split(b"\n") if line.startswith(PCD_COUNTED)]
    lines = [FIELDS if line.startswith(b"FIELDS x y z ") and line.count(b" ") == 4 else line for line in lines]
    if all(lines.count(line) == 1 for line in counted) and not any(b"COUNT" in line for line in set(lines) - {COUNTS}):
        if body.startswith(b"binary\n"):
            rows = np.frombuffer(body[7:][: N * 16], "<f4").reshape(-1, 4)
        else:
            lines = body.partition(b"\n")[2].decode(errors="replace").splitlines()
            rows = np.array([[float(word) for word in line.split()[:3]] for line in lines if line.strip()])
        return np.array_equal(found, rows[:, :3].astype(np.float32), equal_nan=True)
    return np.array_equal(found, POINTS[:, :3])


def _read_classes(path: Path) -> Any:
    return scan_record(path.with_suffix(".bin"), path).classes(20)


def _read_image(path: Path) -> np.ndarray:
    return read_grey_png(path, bits=8)


def _read_label_image(path: Path) -> np.ndarray:
    return read_label_image(path, shape=(8, 6))


IMAGE: dict[str, Damage] = {**BYTES, "kind": other_picture, "size": promise_size}
PCD: dict[str, Damage] = {**BYTES, "header": change_pcd_header}
ROADS = (
    Road("image", "1.png", png(Image.fromarray(GREY)), damages=IMAGE, **as_whole(_read_image, np.rot90(GREY, -1))),
    Road(
        "label image",
        "1.png",
        png(Image.fromarray(RAW)),
        damages=IMAGE,
        **as_whole(_read_label_image, np.rot90(RAW, -1).astype(np.int32)),
    ),
    Road(
        "labels",
        "1.label",
        LABELS.tobytes(),
        _read_classes,
        _same_labels,
        {**BYTES, "ids": other_labels},
        {"1.bin": POINTS.tobytes()},
    ),
    Road("scan .bin", "1.bin", POINTS.tobytes(), read_scan, _same_points, {**BYTES, "size": odd_size}),
    Road("scan .pcd, binary", "1.pcd", PCD_BINARY, read_scan, _same_pcd, PCD),
    Road(
        "scan .pcd, ascii",
        "1.pcd",
        PCD_ASCII,
        read_scan,
        _same_pcd,
        {**PCD, "missing": functools.partial(drop_word, skip=SKIP)},
    ),
)
