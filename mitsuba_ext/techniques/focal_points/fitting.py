"""Finds the boxes through which light passes, from the lines along which paths found light."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

ROUNDS = 12
MOST = 64
LEVELS = 5
FIRST = 4
GRID = 8


def seen(low, high, p, d):
    """p_k(w|x): [lines, boxes]"""
    inv = 1 / np.where(np.abs(d) > 1e-12, d, 1e-12).astype(np.float32)
    enters = np.zeros((len(p), len(low)), np.float32)
    leaves = np.full((len(p), len(low)), np.inf, np.float32)
    for axis in range(3):
        a = (low[None, :, axis] - p[:, None, axis]) * inv[:, None, axis]
        b = (high[None, :, axis] - p[:, None, axis]) * inv[:, None, axis]
        np.maximum(enters, np.minimum(a, b), out=enters)
        np.minimum(leaves, np.maximum(a, b), out=leaves)
    cubes = (leaves - enters) * (leaves * leaves + leaves * enters + enters * enters)
    cubes[leaves <= enters] = 0
    return cubes / (3 * np.prod(high - low, axis=1))[None]


def expectation_maximization(P, bsdf, c, alpha, rounds):
    """alpha[0] is the BSDF."""
    for _ in range(rounds):
        q = alpha[0] * bsdf + P @ alpha[1:]
        r = c / np.maximum(q, 1e-30)
        alpha = alpha * np.concatenate([[r @ bsdf], r @ P])
        alpha /= alpha.sum()
    return alpha


def fitted(bounds, p, d, bsdf, c, log=None):
    """low, high, weights, share"""
    c = c / c.sum()
    edge = (np.array(bounds[1]) - np.array(bounds[0])).max() / GRID
    counts = np.maximum(1, np.ceil((bounds[1] - bounds[0]) / edge)).astype(int)
    cells = np.stack(np.meshgrid(*(np.arange(n) for n in counts), indexing="ij"), -1).reshape(-1, 3)
    low = bounds[0] + cells * edge
    high = low + edge
    alpha = np.concatenate([[0.5], np.full(len(low), 0.5 / len(low))])
    for level in range(LEVELS):
        P = seen(low.astype(np.float32), high.astype(np.float32), p, d).astype(np.float32)
        alpha = expectation_maximization(P, bsdf, c, alpha.astype(np.float32), ROUNDS)
        if log is not None:
            q = alpha[0] * bsdf + P @ alpha[1:]
            log(level, len(low), alpha[0], float((c * np.log(np.maximum(q, 1e-30) / bsdf)).sum()),
                np.sort(alpha[1:])[::-1][:5])
        keep = alpha[1:] > 1e-3
        order = np.argsort(-alpha[1:])
        order = order[keep[order]][:MOST]
        low, high, a = low[order], high[order], alpha[1:][order]
        if level == LEVELS - 1:
            break
        if len(a) == 0:
            break
        # divide the heavy
        heavy = a > 1 / MOST
        offs = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), -1).reshape(-1, 3)
        size = (high - low)[heavy] / 2
        clow = (low[heavy][:, None] + offs[None] * size[:, None])
        chigh = clow + size[:, None]
        low = np.concatenate([low[~heavy], clow.reshape(-1, 3)])
        high = np.concatenate([high[~heavy], chigh.reshape(-1, 3)])
        a = np.concatenate([a[~heavy], np.repeat(a[heavy] / 8, 8)])
        alpha = np.concatenate([[alpha[0]], a])
        alpha /= alpha.sum()
    return low, high, a, 1 - alpha[0]
