"""A scan of a recording is asked for by its number."""

from pathlib import Path

import numpy as np
import pytest
from recordings import of_scans

from sglpr_jax.data.scan_stream import only
from sglpr_jax.maps.query import query_of, read_query


def test_a_frame_has_the_number_of_the_whole_recording():
    recording = of_scans({Path(f"{i}.bin"): np.full((1, 3), i, np.float32) for i in range(9)})
    assert query_of(recording, 4).points[0, 0] == 4
    some = only(only(recording, range(3, 9)), [0, 2, 5])
    assert some.numbers.tolist() == [3, 5, 8] and query_of(some, 5).points[0, 0] == 5
    for frame in (4, 9):
        message = f"08: expected the number of a scan, found {frame}; it has 3 scans from 3 to 8"
        with pytest.raises(ValueError, match=message):
            query_of(some, frame)


def test_a_bag_needs_a_frame(as_installed):
    with pytest.raises(ValueError, match=r"drive\.mcap: expected one scan or image, found a bag; use --frame"):
        read_query(Path("drive.mcap"), None)
