"""Scans of the loop search: description of a scan by descriptor and density image, and storage of described scans."""

import abc
import copy
import functools
import zlib
from collections import OrderedDict
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Complex64, Float32, Int, Num, UInt8

from sglpr_jax.bev import centre_crop, even_cells
from sglpr_jax.data.mounting import Mounting
from sglpr_jax.data.scan import Scan
from sglpr_jax.data.views import check_ready_made, image_view, picture, view
from sglpr_jax.grid import DENSITY_MAX_COUNT
from sglpr_jax.growing import GrowingArray
from sglpr_jax.models.sglpr import describe
from sglpr_jax.models.weights import Params
from sglpr_jax.registration.bev_config import VerificationConfig
from sglpr_jax.registration.bev_spectra import lower_half, match_spectra
from sglpr_jax.retrieval.index import Index


class Keyframe(NamedTuple):
    """Descriptor and image of a scan or ready-made image."""

    descriptor: Float32[np.ndarray, " d"]
    image: UInt8[np.ndarray, "n n"]
    """Central square of the density image or of the ready-made image."""
    mounting: Mounting | None
    """Mounting of the sensor. Descriptor and image are gravity-aligned."""


def describe_scan(params: Params, scan: Scan) -> Keyframe:
    """Compute the descriptor of a scan and its 8-bit density image. The descriptor may be that of another image kind.

    A ready-made image replaces both images. Raises the ValueError of `check_ready_made`.
    """
    model = params.config
    check_ready_made(scan, model.image)
    density_image, _ = picture(scan, None)
    if scan.points is None or model.image == "density":
        model_image = image_view(density_image, None, model.grid).image
    else:
        model_image = view(scan, model.grid, image=model.image).image
    return Keyframe(np.asarray(describe(params, model_image)), _square_8_bit(density_image), scan.mounting)


def square_image(scan: Scan) -> UInt8[np.ndarray, "n n"]:
    """Image for the comparison of scans: the central square of the density image or ready-made image, as 8 bits."""
    return _square_8_bit(picture(scan, None)[0])


def _square_8_bit(image: Num[np.ndarray, "h w"]) -> UInt8[np.ndarray, "n n"]:
    """Central square of an image, with an even number of cells per side. 255 means `DENSITY_MAX_COUNT` or more."""
    even_image = even_cells(np.asarray(image, np.float32))
    size = min(even_image.shape)
    grey = centre_crop(even_image, height=size, width=size) * np.float32(255 / DENSITY_MAX_COUNT)
    return np.round(grey).clip(0, 255).astype(np.uint8)


LEVEL = 1
"""Compression level of zlib, the fastest one. Most cells of an image are empty, so higher levels save little."""
SPECTRA = 512
"""Number of images whose spectra are kept. Consecutive queries are compared with the same scans."""
PARTS = 16
"""With `max_places`, 1 / `PARTS` of the scans are removed at once, because each removal moves all rows that follow."""
EVERY = np.array(True)
"""Flag that broadcasts to all scans."""


class ImageSpectra(NamedTuple):
    """Spectra of an image for the comparison with queries."""

    exact: Complex64[np.ndarray, "s f"]
    """Row of `match_spectra`."""
    coarse: Complex64[np.ndarray, "r g"]
    """The same on larger cells (`lower_half`)."""


class Keyframes(abc.ABC):
    """Described scans with which queries are compared, one row each: those of a session, or the places of a map."""

    index: Index
    """Descriptor of each scan."""
    verification = VerificationConfig()
    """Settings of the spectra."""
    searchable: Bool[np.ndarray, "*n"] = EVERY
    """Whether `nearest` may return each scan, or one value for all."""

    @property
    @abc.abstractmethod
    def frames(self) -> Int[np.ndarray, " n"]:
        """Frame of each scan in the motion."""

    @abc.abstractmethod
    def image(self, row: int) -> UInt8[np.ndarray, "m m"]:
        """Image of a scan."""

    def nearest(
        self, descriptor: Float32[np.ndarray, " d"], k: int, among: Bool[np.ndarray, " n"]
    ) -> Int[np.ndarray, " j"]:
        """Rows of up to k searchable scans with a flag in `among` whose descriptors are nearest, the nearest first."""
        if not k:
            return np.zeros(0, np.int64)
        rows = self.index.query(descriptor, k, exclude=~(among & self.searchable)).rows
        return rows[rows >= 0]  # the index pads with -1

    def spectra(self, rows: Int[np.ndarray, " k"]) -> list[ImageSpectra]:
        """Spectra of the image of each row."""
        return [image_spectra(self.image(row), self.verification) for row in rows.tolist()]


class StoredScans(Keyframes):
    """Scans in the order they were added: row i of the index is scan i. Images are compressed without loss."""

    def __init__(
        self,
        index: Index,
        *,
        verification: VerificationConfig = VerificationConfig(),
        max_places: int | None = None,
    ):
        """Start with an index without places. `max_places` limits the scans, as in `DetectorConfig`."""
        self.index, self.verification, self.max_places = index, verification, max_places
        self._first_frame = 0
        self._frames = GrowingArray(np.empty(0, np.int64))
        self._superseded = GrowingArray(np.empty(0, bool))
        """Whether each scan has a loop to a newer stored scan."""
        self._compressed: list[bytes] = []
        self._shape = 0, 0
        """Compressed image of each scan, and the shape of all of them."""
        self._spectra: OrderedDict[int, ImageSpectra] = OrderedDict()
        """Spectra by frame, the last used one at the end."""

    def __len__(self) -> int:
        return len(self._compressed)

    @property
    def frames(self) -> Int[np.ndarray, " n"]:
        """Frame of each scan, in increasing order."""
        return self._frames.rows + self._first_frame

    def view(self, *, first_frame: int = 0, searchable: Bool[np.ndarray, "*n"] = EVERY) -> "StoredScans":
        """Return the same scans, in shared memory, with other frame numbers or other `searchable` flags.

        `first_frame` is added to the frame numbers.
        """
        scans = copy.copy(self)
        scans._first_frame, scans.searchable = first_frame, searchable
        return scans

    @property
    def nbytes(self) -> int:
        """Number of bytes of descriptors and compressed images, without the kept spectra."""
        arrays = self.index.nbytes + self._frames.nbytes + self._superseded.nbytes
        return arrays + sum(map(len, self._compressed))

    def check(self, frame: int, image: UInt8[np.ndarray, "m m"]) -> None:
        """Raise ValueError if the image of a frame has another shape than the stored images."""
        if len(self) and image.shape != self._shape:
            raise ValueError(f"frame {frame}: expected an image of {self._shape} cells, found {image.shape}")

    def add(self, frame: int, descriptor: Float32[np.ndarray, " d"], image: UInt8[np.ndarray, "m m"]) -> None:
        """Store the scan of a frame. With `max_places` scans, others are removed first. Raises the error of `check`."""
        self.check(frame, image)
        if self.max_places is not None and len(self) >= self.max_places:
            self.forget(max(self.max_places // PARTS, 1))
        self.index.add(descriptor, ids=f"{frame:06d}")
        self._frames.append(frame)
        self._superseded.append(False)
        self._compressed.append(zlib.compress(image.tobytes(), LEVEL))
        self._shape = image.shape

    def close_loop(self, query: int, match: int) -> None:
        """Note a loop between two frames. If both are stored, the match is now superseded by the query."""
        if query in self.frames and match in self.frames:
            self._superseded.rows[np.searchsorted(self.frames, match)] = True

    def forget(self, count: int) -> None:
        """Remove this many scans: first those that have a loop to a newer stored scan, then the oldest."""
        remains = np.ones(len(self), bool)
        remains[np.argsort(~self._superseded.rows, kind="stable")[:count]] = False
        self.index.keep(remains)
        self._frames.keep(remains)
        self._superseded.keep(remains)
        self._compressed = [self._compressed[row] for row in np.flatnonzero(remains)]

    def image(self, row: int) -> UInt8[np.ndarray, "m m"]:
        """Image of a scan, decompressed."""
        return np.frombuffer(zlib.decompress(self._compressed[row]), np.uint8).reshape(self._shape)

    def spectra(self, rows: Int[np.ndarray, " k"]) -> list[ImageSpectra]:
        """Spectra of the image of each row. Those of the `SPECTRA` last used images stay in memory."""
        spectra = []
        for row, frame in zip(rows.tolist(), self._frames.rows[rows].tolist(), strict=True):
            if frame not in self._spectra:
                self._spectra[frame] = image_spectra(self.image(row), self.verification)
            self._spectra.move_to_end(frame)  # the order of last use
            spectra.append(self._spectra[frame])
        while len(self._spectra) > SPECTRA:
            self._spectra.popitem(last=False)
        return spectra


def image_spectra(image: UInt8[np.ndarray, "m m"], config: VerificationConfig) -> ImageSpectra:
    """Spectra of one image."""
    return ImageSpectra(*jax.device_get(_image_spectra(image, config)))


@functools.partial(jax.jit, static_argnames="config")
def _image_spectra(image: UInt8[Array, "m m"], config: VerificationConfig) -> tuple[Array, Array]:
    exact = match_spectra(image[None], config=config)
    return exact[0], lower_half(exact, config)[0]
