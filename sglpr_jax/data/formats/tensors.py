"""Reproducible safetensors files: equal arrays give equal bytes."""

import json
from collections.abc import Mapping

import numpy as np
import safetensors.numpy


def tensors_as_bytes(arrays: Mapping[str, np.ndarray], metadata: Mapping[str, str]) -> bytes:
    """Return the content of a safetensors file of C-contiguous arrays, with `metadata` sorted by name.

    The safetensors library itself writes metadata in arbitrary order.
    """
    content = safetensors.numpy.save(dict(arrays), dict(metadata))
    size = int.from_bytes(content[:8], "little")
    header = json.loads(content[8 : 8 + size])
    header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)  # the arrays after the header are aligned to 8 bytes
    return b"".join([len(text).to_bytes(8, "little"), text, memoryview(content)[8 + size :]])
