"""A recording has everything once for each of its scans."""

from pathlib import Path

import numpy as np
import pytest
from recordings import of_scans

CLOUDS = {Path(f"{i}.bin"): np.ones((5, 3), np.float32) for i in range(3)}


@pytest.mark.parametrize(
    "fields, message",
    [
        ({"positions": np.zeros((5, 3))}, "sequence 08: expected 3 positions, one per scan, found 5"),
        ({"times": np.zeros(2)}, "expected 3 times, one per scan, found 2"),
        ({"label_paths": (None,)}, "expected 3 label_paths, one per scan, found 1"),
        ({"ids": ("0", "1")}, "expected 2 paths, one per scan, found 3"),
        ({"ids": ("0", "1", "1")}, "expected a unique id for each scan, found '1' twice"),
    ],
)
def test_what_is_not_there_once_for_each_scan_is_refused(fields, message):
    assert len(of_scans(CLOUDS)) == 3
    with pytest.raises(ValueError, match=message):
        of_scans(CLOUDS, **fields)
