"""What follows a path for an estimator: its history, and what reads it."""

from __future__ import annotations

import inspect

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.transport.estimator import CameraRays, Sample
from mitsuba_ext.transport.path_program import EndingProgram, PathProgram, Subpaths
from mitsuba_ext.transport.walk import Walk
from mitsuba_ext.transport.without_lengths import WithoutLengths

pytestmark = pytest.mark.usefixtures("variant")

LANES = 1000


def _sample(walk: Walk) -> Sample:
    scene = mi.load_dict(mi.cornell_box())
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, LANES)
    ray = mi.Ray3f(mi.Point3f(0.1, 0.2, -0.5), dr.normalize(mi.Vector3f(0.3, 0.2, -1)))
    ray.time = dr.zeros(mi.Float, LANES)
    return walk(scene, sampler, CameraRays(ray), mi.Bool(True))


class _EndsAtOnce(EndingProgram):
    """Ends each path at its first vertex, whose depth is the history."""

    def begin(self, ray):
        return mi.UInt32(0)

    def leave(self, vertex, bs):
        return vertex.path.history + 1

    def survival(self, roulette, state, vertex, path, late, active):
        survival, state = super().survival(roulette, state, vertex, path, late, active)
        return dr.select(path.history == 1, 0, survival), state


class _Known(PathProgram):
    """Knows a radiance of 1 behind the first vertex."""

    def known(self, vertex, bs, β, history, active):
        return dr.select(active & (vertex.depth == 0), mi.Spectrum(1), 0), history


class _Bright(Subpaths):
    """Brings a radiance of 1 to the first vertex, by two shadow rays."""

    def gather(self, scene, sampler, vertex, active):
        is_first = active & (vertex.depth == 0)
        return dr.select(is_first, mi.Spectrum(1), 0), dr.select(is_first, mi.UInt32(2), 0)


def test_a_program_ends_paths_before_the_depth_of_roulette() -> None:
    alone = _sample(Walk(5, 4))
    ended = _sample(Walk(5, 4, program=_EndsAtOnce()))
    assert dr.all(ended.scatter_count == 0)
    assert dr.all(alone.scatter_count > 0)
    # Direct light at the first vertex, with the same random numbers
    direct = _sample(Walk(2, 4))
    np.testing.assert_array_equal(ended.shadow_count.numpy(), direct.shadow_count.numpy())


def test_a_program_that_ends_no_path_early_changes_nothing() -> None:
    alone, ending = (_sample(Walk(6, 2, program=p)) for p in (PathProgram(), EndingProgram()))
    np.testing.assert_array_equal(alone.scatter_count.numpy(), ending.scatter_count.numpy())
    np.testing.assert_allclose(alone.L.numpy(), ending.L.numpy(), rtol=1e-5)


def test_what_is_known_of_a_direction_is_added() -> None:
    difference = _sample(Walk(5, 4, program=_Known())).L - _sample(Walk(5, 4)).L
    np.testing.assert_allclose(difference.numpy(), 1, atol=1e-5)


def test_other_subpaths_add_their_light_and_their_rays() -> None:
    program = PathProgram()
    program.subpaths = _Bright()
    with_them, alone = _sample(Walk(5, 4, program=program)), _sample(Walk(5, 4))
    np.testing.assert_allclose((with_them.L - alone.L).numpy(), 1, atol=1e-5)
    assert dr.all(with_them.shadow_count == alone.shadow_count + 2)


def test_lengths_that_are_left_out_and_the_others_add_up() -> None:
    whole = _sample(Walk(5, 4)).L.numpy()
    parts = [
        _sample(Walk(5, 4, program=WithoutLengths(PathProgram(), *lengths))).L.numpy()
        for lengths in ((1, 2), (3, 5))
    ]
    assert all(part.max() > 0 for part in parts)
    np.testing.assert_allclose(sum(parts), whole, rtol=1e-4, atol=1e-5)


def test_the_program_that_leaves_lengths_out_asks_the_other_one_for_all_else() -> None:
    methods = {name for name, _ in inspect.getmembers(PathProgram, inspect.isfunction)}
    assert methods <= set(vars(WithoutLengths))
    inner = _EndsAtOnce()
    inner.subpaths = _Bright()
    outer = WithoutLengths(inner, 1, 2)
    assert outer.ends_early and outer.subpaths is inner.subpaths
