"""Oracles of the networks' layers in plain NumPy and double precision, written from their definitions."""

import numpy as np


def sigmoid(x):
    return 0.5 * (1.0 + np.tanh(0.5 * np.asarray(x, np.float64)))


def silu(x):
    return x * sigmoid(x)


def softmax(x):
    """Over the last axis."""
    e = np.exp(x - x.max(axis=-1, keepdims=True))
    return e / e.sum(axis=-1, keepdims=True)


def dense(params, x):
    return np.asarray(x, np.float64) @ np.float64(params["kernel"]) + np.float64(params.get("bias", 0.0))


def layer_norm(params, x, eps=1e-5):
    x = np.asarray(x, np.float64)
    out = (x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + eps)
    return out * np.float64(params["scale"]) + np.float64(params["bias"])


def convolve(x, kernel, stride, pad):
    """`[n, h, w, c]` with `[k, k, c, d]`, zeros around it: every output is a loop over its window."""
    x, kernel = np.asarray(x, np.float64), np.asarray(kernel, np.float64)
    k, n = kernel.shape[0], x.shape[0]
    rows, columns = ((s + 2 * pad - k) // stride + 1 for s in x.shape[1:3])
    padded = np.pad(x, ((0, 0), (pad, pad), (pad, pad), (0, 0)))
    out = np.zeros((n, rows, columns, kernel.shape[3]))
    for i in range(rows):
        for j in range(columns):
            window = padded[:, i * stride : i * stride + k, j * stride : j * stride + k]
            out[:, i, j] = np.einsum("nabc,abcd->nd", window, kernel)
    return out


def depthwise(x, kernel, stride):
    """`[n, h, w, c]` with `[k, k, c]`, one filter per channel: a loop over pixels and taps, without padded arrays."""
    x, kernel = np.asarray(x, np.float64), np.asarray(kernel, np.float64)
    (n, h, w, c), k = x.shape, kernel.shape[0]
    half = k // 2
    rows, columns = ((s + 2 * half - k) // stride + 1 for s in (h, w))
    out = np.zeros((n, rows, columns, c))
    for i in range(rows):
        for j in range(columns):
            for a in range(k):
                for b in range(k):
                    y, z = i * stride + a - half, j * stride + b - half
                    if 0 <= y < h and 0 <= z < w:
                        out[:, i, j] += x[:, y, z] * kernel[a, b]
    return out


def depthwise_gradients(x, kernel, stride, g):
    """Of Σ g · depthwise(x, kernel), by the same loop backwards."""
    x, kernel, g = (np.asarray(a, np.float64) for a in (x, kernel, g))
    half, (_, h, w, _) = kernel.shape[0] // 2, x.shape
    dx, dk = np.zeros_like(x), np.zeros_like(kernel)
    for i in range(g.shape[1]):
        for j in range(g.shape[2]):
            for a in range(kernel.shape[0]):
                for b in range(kernel.shape[0]):
                    y, z = i * stride + a - half, j * stride + b - half
                    if 0 <= y < h and 0 <= z < w:
                        dx[:, y, z] += g[:, i, j] * kernel[a, b]
                        dk[a, b] += (g[:, i, j] * x[:, y, z]).sum(axis=0)
    return dx, dk


def attention(params, queries, keys, mask, num_heads):
    """Frame by frame, query by query, head by head; only keys that the mask holds are looked at."""
    queries, keys = np.asarray(queries, np.float64), np.asarray(keys, np.float64)
    (b, q, d), size = queries.shape, queries.shape[2] // num_heads
    out = np.zeros((b, q, d))
    for frame in range(b):
        there = np.flatnonzero(mask[frame])
        if not there.size:
            continue
        q_all, k_all, v_all = (
            dense(params[name], x)
            for name, x in (("query", queries[frame]), ("key", keys[frame, there]), ("value", keys[frame, there]))
        )
        for i in range(q):
            found = []
            for head in range(num_heads):
                part = slice(head * size, (head + 1) * size)
                weights = softmax(k_all[:, part] @ q_all[i, part] / np.sqrt(size))
                found.append(weights @ v_all[:, part])
            out[frame, i] = dense(params["out"], np.concatenate(found))
    return out


def affine(params, x):
    return np.asarray(x, np.float64) * np.float64(params["scale"]) + np.float64(params["bias"])


def encoder(spec, params, images):
    """EfficientNet from its parameters: feature maps by stride, `affine`, `layer` and `block` norms."""
    mean, std = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])
    act = {"silu": silu, "relu": lambda x: np.maximum(x, 0)}[spec.activation]
    inner = {"layer": layer_norm, "affine": affine, "block": layer_norm}[spec.norm]
    kernel, stride, _ = spec.stem
    pad = 0 if kernel == stride else kernel // 2
    x = convolve((images - mean) / std, params["stem"]["kernel"], stride, pad)
    x = act(inner(params["stem_norm"], x))
    now, maps = stride, {stride: x}
    for number, (_, expand, _, step, channels) in enumerate(spec.blocks()):
        p, before = params[f"block{number}"], x
        norm = (lambda name, y, p=p: y) if spec.norm == "block" else (lambda name, y, p=p: inner(p[name], y))
        y = layer_norm(p["norm"], x) if spec.norm == "block" else x
        if expand > 1:
            y = act(norm("expand_norm", dense(p["expand"], y)))
        y = depthwise(y, p["depthwise"], step) + np.float64(p.get("depthwise_bias", 0.0))
        y = act(norm("depthwise_norm", y))
        squeezed = act(dense(p["excite"]["reduce"], y.mean(axis=(1, 2))))
        y = y * sigmoid(dense(p["excite"]["expand"], squeezed))[:, None, None, :]
        y = norm("project_norm", dense(p["project"], y))
        x = before + y if step == 1 and before.shape[-1] == channels else y
        now *= step
        maps[now] = x
    if spec.head:
        x = act(inner(params["head_norm"], dense(params["head"], x)))
        maps[now] = x
    if spec.num_classes:
        maps[0] = dense(params["classifier"], x.mean(axis=(1, 2)))
    return maps
