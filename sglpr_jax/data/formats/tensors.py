"""Arrays as safetensors, in the same bytes whenever they are the same."""

import json
from collections.abc import Mapping

import numpy as np
import safetensors.numpy


def tensors_as_bytes(arrays: Mapping[str, np.ndarray], metadata: Mapping[str, str]) -> bytes:
    """The content of a safetensors file of C-contiguous arrays, with `metadata` in the order of its names.

    The library writes them in any order.
    """
    content = safetensors.numpy.save(dict(arrays), dict(metadata))
    size = int.from_bytes(content[:8], "little")
    header = json.loads(content[8 : 8 + size])
    header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)  # the arrays behind it stand at multiples of 8
    return b"".join([len(text).to_bytes(8, "little"), text, memoryview(content)[8 + size :]])
