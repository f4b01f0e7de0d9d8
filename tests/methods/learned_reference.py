"""The networks of other publications in numpy, and their inputs, from their definitions."""

import math

import jax
import numpy as np
from scipy.special import expit as sigmoid


def moved(variables, *, seed=0):
    """Variables in numpy as after some training: no layer is zero, and the statistics are not those of the start."""
    rng = np.random.default_rng(seed)
    limits = {"var": (0.5, 2.0), "scale": (0.5, 1.5), "mean": (-0.2, 0.2), "bias": (-0.2, 0.2)}

    def draw(path, leaf):
        if path[-1].key in limits:
            return rng.uniform(*limits[path[-1].key], leaf.shape).astype(np.float32)
        noise = rng.standard_normal(leaf.shape, np.float32)
        return np.asarray(leaf) + 0.1 * np.float32(leaf.shape[0] ** -0.5) * noise

    return jax.tree_util.tree_map_with_path(draw, variables)


def conv(x, kernel, *, stride=1, circular=False):
    """Correlate images (b, h, w, c) with a square kernel. Rows are padded by zeros, columns by zeros or wrapped."""
    border = len(kernel) // 2
    x = np.pad(x, ((0, 0), (0, 0), (border, border), (0, 0)), mode="wrap" if circular else "constant")
    x = np.pad(x, ((0, 0), (border, border), (0, 0), (0, 0)))
    patches = np.lib.stride_tricks.sliding_window_view(x, kernel.shape[:2], axis=(1, 2))[:, ::stride, ::stride]
    return np.einsum("bhwcij,ijcf->bhwf", patches, kernel)


def norm(x, layer, statistics, epsilon=1e-5):
    """Batch normalisation by running statistics."""
    return (x - statistics["mean"]) / np.sqrt(statistics["var"] + epsilon) * layer["scale"] + layer["bias"]


def pool(x, *, size, border=0):
    """Maximum of squares with stride 2."""
    x = np.pad(x, ((0, 0), (border, border), (border, border), (0, 0)), constant_values=-np.inf)
    return np.lib.stride_tricks.sliding_window_view(x, (size, size), axis=(1, 2))[:, ::2, ::2].max((-2, -1))


def unit(x):
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


def dense(x, layer):
    return x @ layer["kernel"] + layer.get("bias", 0)


def residual_sums(x, logits, centres):
    """Sum over the features (n, d) of softmax(logits) (x - centre), each of length 1, for the centres (k, d)."""
    share = np.exp(logits - logits.max(1, keepdims=True))
    share /= share.sum(1, keepdims=True)
    return np.stack([unit((share[:, k : k + 1] * (x - centre)).sum(0)) for k, centre in enumerate(centres)])


def netvlad(x, layer):
    return unit(residual_sums(x, x @ layer["assignment"], layer["centres"]).ravel())


def encoder(variables, grey):
    """ResNet-34 until the end of its second stage, of three equal colours."""
    weights, stats = (variables[kind]["Encoder_0"] for kind in ("params", "batch_stats"))
    x = conv(np.repeat(grey[..., None], 3, -1), weights["kernel"], stride=2)
    x = pool(np.maximum(norm(x, weights["BatchNorm_0"], stats["BatchNorm_0"]), 0), size=3, border=1)
    for number in range(7):
        layer, own, stride = weights[f"Block_{number}"], stats[f"Block_{number}"], 2 if number == 3 else 1
        y = norm(conv(x, layer["Convolution_0"]["kernel"], stride=stride), layer["BatchNorm_0"], own["BatchNorm_0"])
        y = norm(conv(np.maximum(y, 0), layer["Convolution_1"]["kernel"]), layer["BatchNorm_1"], own["BatchNorm_1"])
        if stride > 1:
            x = conv(x, layer["Convolution_2"]["kernel"], stride=stride)
            x = norm(x, layer["BatchNorm_2"], own["BatchNorm_2"])
        x = np.maximum(x + y, 0)
    return x


def doubled(x):
    """Rings between coinciding corners, sectors between neighbours on the circle."""
    _, h, w, _ = x.shape
    found = np.zeros((len(x), 2 * h, 2 * w, x.shape[3]))
    for i in range(2 * h):
        at = i * (h - 1) / (2 * h - 1)
        low = min(int(at), h - 2)
        row = x[:, low] * (low + 1 - at) + x[:, low + 1] * (at - low)
        for j in range(2 * w):
            left = math.floor((j - 0.5) / 2)
            share = (j - 0.5) / 2 - left
            found[:, i, j] = row[:, left % w] * (1 - share) + row[:, (left + 1) % w] * share
    return found


def disco(variables, cells):
    """The U-Net of one grid, and its lowest frequencies."""
    weights, stats = variables["params"], variables["batch_stats"]
    x, skipped = cells[None].astype(np.float32), []
    for number in range(7):
        if number > 3:
            x = np.concatenate([skipped.pop(), doubled(x)], axis=-1)
        for i in range(2):
            layer, own = weights[f"Block_{number}"], stats[f"Block_{number}"]
            x = conv(x, layer[f"Convolution_{i}"]["kernel"], circular=True) + layer[f"Convolution_{i}"]["bias"]
            x = norm(x, layer[f"BatchNorm_{i}"], own[f"BatchNorm_{i}"])
            x = sigmoid(x) if (number, i) == (6, 1) else np.maximum(x, 0)
        if number < 3:
            skipped.append(x)
            x = pool(x, size=2)
    shifted = np.fft.fftshift(np.abs(np.fft.fft2(dense(x, weights["Dense_0"])[0, ..., 0], norm="ortho")))
    return shifted[4:36, 44:76].reshape(-1)


def overlap_transformer(variables, image):
    """The network of one image, with every head on its own."""
    weights = variables["params"]
    x = image[..., None]
    for number, (height, stride) in enumerate(((4, 2), (4, 2), (4, 2), (4, 2), (2, 1))):
        rows = (len(x) - height) // stride + 1
        stack = [np.concatenate(x[i * stride : i * stride + height], axis=-1) for i in range(rows)]
        x = np.maximum(dense(np.stack(stack), weights[f"Dense_{number}"]), 0)
    x = np.maximum(dense(x[0], weights["Dense_5"]), 0)
    y = dense(
        netvlad(unit(np.concatenate([x, _transformer(x, weights["Transformer_0"])], -1)), weights["NetVLAD_0"]),
        weights["Dense_6"],
    )
    return unit(y * sigmoid(dense(y, weights["Dense_7"])))


def _transformer(x, weights):
    attention = weights["MultiHeadDotProductAttention_0"]
    mixed = attention["out"]["bias"].astype(np.float64)
    for head in range(4):
        query, key, value = (
            x @ attention[name]["kernel"][:, head] + attention[name]["bias"][head] for name in ("query", "key", "value")
        )
        share = np.exp(query @ key.T / math.sqrt(query.shape[1]))
        mixed = mixed + share / share.sum(1, keepdims=True) @ value @ attention["out"]["kernel"][head]
    x = _layer_norm(x + mixed, weights["LayerNorm_0"])
    return _layer_norm(
        x + dense(np.maximum(dense(x, weights["Dense_0"]), 0), weights["Dense_1"]), weights["LayerNorm_1"]
    )


def _layer_norm(x, layer):
    centred = x - x.mean(-1, keepdims=True)
    return centred / np.sqrt((centred**2).mean(-1, keepdims=True) + 1e-6) * layer["scale"] + layer["bias"]


def pointnetvlad(variables, points):
    """The network of one scan."""
    weights, stats = variables["params"], variables["batch_stats"]

    def mlp(x, layers, own=None):
        for i in range(sum(name.startswith("Dense") for name in layers)):
            x = dense(x, layers[f"Dense_{i}"])
            x = x if own is None else norm(x, layers[f"BatchNorm_{i}"], own[f"BatchNorm_{i}"], 1e-3)
            x = np.maximum(x, 0)
        return x

    def transformed(x, name):
        layers, own = weights[name], stats[name]
        features = mlp(x, layers["Mlp_0"], own["Mlp_0"]).max(axis=0)
        matrix = dense(mlp(features, layers["Mlp_1"], own["Mlp_1"]), layers["Dense_0"])
        return x @ (matrix.reshape(x.shape[1], -1) + np.eye(x.shape[1]))

    features = mlp(transformed(points.astype(np.float64), "TNet_0"), weights["Mlp_0"])
    x = unit(mlp(transformed(features, "TNet_1"), weights["Mlp_1"]))
    layer, own = weights["Vlad_0"], stats["Vlad_0"]
    logits = norm(dense(x, layer["clusters"]), layer["BatchNorm_0"], own["BatchNorm_0"], 1e-3)
    vlad = unit(residual_sums(x, logits, layer["centres"].T).T.ravel())
    y = norm(dense(vlad, layer["hidden"]), layer["BatchNorm_1"], own["BatchNorm_1"], 1e-3)
    return unit(y * sigmoid(norm(dense(y, layer["gate"]), layer["BatchNorm_2"], own["BatchNorm_2"], 1e-3)))


def sgpr(variables, nodes):
    """The network of one graph, node by node, as published: the kernels of both halves of an edge as one."""
    weights, stats = variables["params"], variables["batch_stats"]

    def leaky(x, layer, own):
        y = norm(x, layer, own)
        return np.where(y > 0, y, 0.2 * y)

    def edges(x, name, ties=None):
        layer, rows = weights[name], []
        kernel = np.concatenate([layer["relative"]["kernel"], layer["own"]["kernel"]])
        for i in range(len(x)):
            apart = ((x - x[i]) ** 2).sum(axis=1)
            order = np.argsort(apart, kind="stable") if ties is None else np.lexsort((ties[i], apart.round(6)))
            pairs = np.stack([np.concatenate([x[j] - x[i], x[i]]) @ kernel for j in order[:10]])
            rows.append(leaky(pairs, layer["BatchNorm_0"], stats[name]["BatchNorm_0"]).max(axis=0))
        return np.stack(rows)

    space, kinds = nodes[:, :3].astype(np.float64), nodes[:, 3:].astype(np.float64)
    ties = np.linalg.norm(space[:, None] - space[None], axis=2)
    for depth in range(3):
        space = edges(space, f"space_{depth}")
        kinds = edges(kinds, f"kinds_{depth}", ties if depth == 0 else None)
    x = leaky(dense(np.concatenate([space, kinds], axis=1), weights["joint"]), weights["norm"], stats["norm"])
    context = np.tanh(dense(x, weights["attention"]["Dense_0"]).mean(axis=0))
    return sum(node * sigmoid(node @ context) for node in x)


def sgpr_logit(variables, a, b):
    """Log odds that two vectors show one place."""
    weights = variables["params"]["comparison"]
    forms = [a @ weights["tensor"][:, :, k] @ b for k in range(16)]
    hidden = np.array(forms) + weights["linear"].T @ np.concatenate([a, b]) + weights["bias"][:, 0]
    return float(dense(np.maximum(dense(np.maximum(hidden, 0), weights["hidden"]), 0), weights["score"])[0])


def rinet_logit(variables, a, b):
    """Log odds that two descriptors show one place."""
    weights = variables["params"]["score"]
    hidden = dense(np.abs(a - b), weights["Dense_0"])
    return dense(np.where(hidden > 0, hidden, 0.1 * hidden), weights["Dense_1"])[..., 0]


def occupancy(points, _):
    """DiSCO's input: 40 rings of 1.75 m, 120 sectors, 20 layers of 0.5 m."""
    cells = np.zeros((40, 120, 20))
    for x, y, z in points.tolist():
        radius, degrees = math.hypot(x, y), math.degrees(math.atan2(y, x)) % 360
        layer = math.floor((z + 1.5) / 0.5)
        if 1 <= radius < 70 and 0 <= layer < 20:
            cells[int(radius / 1.75), int(degrees / 3), layer] = 1
    return cells


def range_image(points, _):
    """OverlapTransformer's input: the nearest point of each pixel."""
    image = np.zeros((64, 900))
    for x, y, z in points.tolist():
        distance = math.sqrt(x * x + y * y + z * z)
        row = math.floor((15 - math.degrees(math.atan2(z, math.hypot(x, y)))) / 0.625)
        column = int(math.degrees(math.atan2(y, x)) % 360 / 0.4) % 900
        if distance <= 80 and 0 <= row < 64 and not 0 < image[row, column] < distance / 80:
            image[row, column] = distance / 80
    return image


def ring_image(points, classes):
    """RINet's input: the nearest point of each class in each degree, the farthest of the road."""
    image, rows = np.zeros((12, 360)), (1, *range(9, 20))
    for (x, y, _), label in zip(points.astype(float), classes, strict=True):
        reach = np.hypot(x, y)
        if label in rows and reach <= 50:
            cell = rows.index(label), int(np.floor((np.arctan2(y, x) + np.pi) * 180 / np.pi))
            choose = max if label == 9 else min
            image[cell] = choose(image[cell], reach) if image[cell] else reach
    return image / 50
