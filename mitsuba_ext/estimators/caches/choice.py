"""Chooses which of many uncovered places get a record: no two of them are close to each other."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from .records import Places, Records

#: Two records are at least this far apart, in units of the smaller of the radii that are expected.
_SPACING = 0.7

#: Records whose normals have a smaller cosine do not serve each other.
_SAME_NORMAL = 0.9


def chosen(
    places: Places, records: Records, accuracy: float, bounds: tuple[float, float], seed: int
) -> np.ndarray:
    """The indices of the places that get a record.

    Parameters:
        places: Places that no record covers.
        records: The records that exist. The nearest one tells the radius that is expected.
        accuracy: a of Eq. 10.9.
        bounds: The smallest and the largest reach, in widths of a pixel.
        seed: Decides which of two places wins.
    """
    if not len(places):
        return np.zeros(0, int)
    least, most = (places.footprint * bound for bound in bounds)
    reach = most
    if len(records):
        distance, nearest = cKDTree(records.p).query(places.p)
        # Far from all records, little is known: half of the reach that fits up to the nearest one
        reach = np.clip(np.maximum(records.reach[nearest], 0.5 * distance / accuracy), least, most)
    spacing = _SPACING * accuracy * reach
    priority = np.random.default_rng(seed).permutation(len(places))
    kept = _one_per_cell(places, 0.5 * spacing, priority)
    return np.sort(kept[_independent(places[kept], spacing[kept], priority[kept])])


def _one_per_cell(places: Places, width: np.ndarray, priority: np.ndarray) -> np.ndarray:
    """The first place of each cell, by priority. Cells are as wide as the spacing of their places,
    up to a factor of two; places of different orientation are in different cells."""
    level = np.floor(np.log2(width)).astype(np.int64)
    cell = np.floor(places.p / (2.0**level)[:, None]).astype(np.int64)
    faces = np.round(2 * places.n).astype(np.int64)
    order = np.argsort(priority)
    keys = np.column_stack([level, cell, faces])[order]
    return order[np.unique(keys, axis=0, return_index=True)[1]]


def _independent(places: Places, spacing: np.ndarray, priority: np.ndarray) -> np.ndarray:
    """A maximal set of places that are not closer to each other than ``spacing``. Each iteration
    takes the places whose priority is highest among their neighbours (M. Luby, 1986)."""
    alive, wins = np.ones(len(places), bool), np.zeros(len(places), bool)
    pairs = _close_pairs(places, spacing)
    while alive.any():
        pairs = pairs[alive[pairs].all(axis=1)]
        loses = np.zeros(len(places), bool)
        first_is_less = priority[pairs[:, 0]] < priority[pairs[:, 1]]
        loses[np.where(first_is_less, pairs[:, 1], pairs[:, 0])] = True
        new = alive & ~loses
        wins |= new
        beaten = pairs[new[pairs].any(axis=1)]
        alive[new] = False
        alive[beaten.ravel()] = False
    return np.flatnonzero(wins)


def _close_pairs(places: Places, spacing: np.ndarray) -> np.ndarray:
    """Pairs of places closer than the smaller spacing of the two, on surfaces that face alike."""
    found = []
    # By octaves, so that a wide spacing finds no crowds of places with a small one
    octave = np.floor(np.log2(spacing)).astype(int)
    tree = cKDTree(places.p)
    for value in np.unique(octave):
        own = np.flatnonzero(octave == value)
        lists = tree.query_ball_point(places.p[own], spacing[own])
        first = np.repeat(own, [len(near) for near in lists])
        second = np.concatenate([np.asarray(near, int) for near in lists])
        # Keeps pairs whose second place has no smaller spacing: its octave finds all others
        keeps = (spacing[second] > spacing[first]) | (
            (spacing[second] == spacing[first]) & (second > first)
        )
        found.append(np.column_stack([first, second])[keeps])
    pairs = np.concatenate(found)
    cosine = (places.n[pairs[:, 0]] * places.n[pairs[:, 1]]).sum(axis=1)
    return pairs[cosine > _SAME_NORMAL]
