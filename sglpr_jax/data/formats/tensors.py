"""Safetensors files, written reproducibly: equal arrays and metadata give equal bytes. Hashes of arrays."""

import hashlib
import json
from collections.abc import Mapping
from typing import Any

import numpy as np
import safetensors.numpy


def tensors_as_bytes(arrays: Mapping[str, np.ndarray], metadata: Mapping[str, str]) -> bytes:
    """Return the content of a safetensors file of C-contiguous arrays, with `metadata` sorted by name.

    The safetensors library writes metadata in arbitrary order, so the header of its file is replaced. A file consists
    of the size of the header (8 bytes), the header in JSON, and the arrays.
    """
    content = safetensors.numpy.save(dict(arrays), dict(metadata))
    end = 8 + int.from_bytes(content[:8], "little")
    header = json.loads(content[8:end])
    header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
    header_bytes = json.dumps(header, separators=(",", ":")).encode()
    header_bytes += b" " * (-len(header_bytes) % 8)  # the arrays after the header are aligned to 8 bytes
    return b"".join([len(header_bytes).to_bytes(8, "little"), header_bytes, memoryview(content)[end:]])


def hash_of(named: Mapping[str, Any], *, about: str = "") -> str:
    """Return the SHA-256 of a text and of names, shapes, types and values of arrays, in the order of their names."""
    digest = hashlib.sha256(about.encode())
    for name, array in sorted(named.items()):
        digest.update(f"{name} {array.shape} {array.dtype}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
