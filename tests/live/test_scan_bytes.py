"""A scan of a live map comes back from its bytes, and bytes of another scan are refused."""

import zlib
from pathlib import Path

import numpy as np
import pytest

from sglpr_jax.data.mounting import Mounting
from sglpr_jax.live.scan_bytes import LiveScan, from_bytes, to_bytes
from sglpr_jax.loops.candidates import Compared
from sglpr_jax.loops.comparison import NO_FITS, Fits
from sglpr_jax.loops.keyframes import Seen
from sglpr_jax.odometry.bev_odometry import Link
from sglpr_jax.registration.bev_search import Peak

DRAW = np.random.default_rng(0)
FITS = Fits(np.array([1, 4]), Peak(*DRAW.normal(size=(5, 2))))
SEEN = Seen(np.ones(4, np.float32), np.ones((6, 6), np.uint8), Mounting(1.5))


def live_scan(fits: Fits, **more) -> LiveScan:
    given = {"pose": np.eye(4), "continues": True, "name": "a", "stamp": 1.0, "time": 2.0, "wall": 3.0}
    return LiveScan(SEEN, Compared(fits, Link(*DRAW.normal(size=6))), **given | more)


@pytest.mark.parametrize("scan", [live_scan(FITS), live_scan(NO_FITS, pose=None, continues=False)])
def test_a_scan_comes_back(scan):
    found = from_bytes(to_bytes(scan), 5, source=Path("journal.bin"))
    assert found.seen.mounting == scan.seen.mounting and found[3:] == scan[3:]
    np.testing.assert_array_equal(found.seen.image, scan.seen.image)
    np.testing.assert_array_equal(found.compared.fits.frames, scan.compared.fits.frames)
    np.testing.assert_array_equal(np.stack(found.compared.fits.peaks), np.stack(scan.compared.fits.peaks))
    np.testing.assert_array_equal(found.compared.link, scan.compared.link)
    assert (found.pose is None) == (scan.pose is None)


def test_fits_with_later_scans_and_damaged_bytes_are_refused():
    content = to_bytes(live_scan(FITS))
    for wrong, frame in ((content, 4), (content[:-9], 5), (zlib.compress(b"no scan"), 5)):
        with pytest.raises(ValueError, match=rf"journal\.bin: expected scan {frame} of a live map, found others"):
            from_bytes(wrong, frame, source=Path("journal.bin"))
