"""The layers of the networks on images, written in numpy from their definitions."""

import numpy as np


def conv(x, kernel, *, stride=1, circular=False):
    """Correlate images (b, h, w, c) with a square kernel. Rows are padded by zeros, columns by zeros or wrapped."""
    border = len(kernel) // 2
    x = np.pad(x, ((0, 0), (0, 0), (border, border), (0, 0)), mode="wrap" if circular else "constant")
    x = np.pad(x, ((0, 0), (border, border), (0, 0), (0, 0)))
    patches = np.lib.stride_tricks.sliding_window_view(x, kernel.shape[:2], axis=(1, 2))[:, ::stride, ::stride]
    return np.einsum("bhwcij,ijcf->bhwf", patches, kernel)


def norm(x, layer, statistics):
    """Batch normalisation by running statistics."""
    return (x - statistics["mean"]) / np.sqrt(statistics["var"] + 1e-5) * layer["scale"] + layer["bias"]


def pool(x, *, size, border=0):
    """Maximum of squares with stride 2."""
    x = np.pad(x, ((0, 0), (border, border), (border, border), (0, 0)), constant_values=-np.inf)
    return np.lib.stride_tricks.sliding_window_view(x, (size, size), axis=(1, 2))[:, ::2, ::2].max((-2, -1))


def netvlad(x, layer):
    """NetVLAD of one image's features (n, d), cluster by cluster."""
    logits = x @ layer["assignment"]
    share = np.exp(logits - logits.max(1, keepdims=True))
    share /= share.sum(1, keepdims=True)
    found = []
    for k, centre in enumerate(layer["centres"]):
        residual = (share[:, k : k + 1] * (x - centre)).sum(0)
        found.append(residual / np.linalg.norm(residual))
    return np.concatenate(found) / np.linalg.norm(np.concatenate(found))


def random_statistics(variables, *, seed=0):
    """Variables in numpy, whose running statistics, scales and biases are random."""
    rng = np.random.default_rng(seed)

    def draw(path, leaf):
        names = {"var": (0.5, 2.0), "scale": (0.5, 1.5), "mean": (-0.2, 0.2), "bias": (-0.2, 0.2)}
        limits = names.get(path)
        return np.asarray(leaf) if limits is None else rng.uniform(*limits, np.shape(leaf)).astype(np.float32)

    def walk(tree, name=""):
        return {key: walk(child, key) for key, child in tree.items()} if hasattr(tree, "items") else draw(name, tree)

    return walk(variables)
