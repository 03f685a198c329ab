"""Irradiance caching with gradients."""

from __future__ import annotations

import functools
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_ext.composition import learned_file
from mitsuba_ext.composition.irradiance_rounds import CacheParameters, CacheRounds, deadline
from mitsuba_ext.composition.slots import read_slot
from mitsuba_ext.composition.walk_integrator import WalkIntegrator
from mitsuba_ext.irradiance.cached_light import CachedLight, CameraPhases, EndsAtTheCache
from mitsuba_ext.irradiance.gathering import Gatherer
from mitsuba_ext.irradiance.hemisphere import Strata
from mitsuba_ext.irradiance.records import Records
from mitsuba_ext.scene.movers import movers
from mitsuba_ext.startup import registry
from mitsuba_ext.transport.emission import can_be_hit
from mitsuba_ext.transport.walk import Walk


@registry.plugin
class IrradianceCache(WalkIntegrator):
    r"""
    TODO
    """

    sees_media = False

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.accuracy = self.parameter(props, "accuracy", 0.3, minimum=0.01, maximum=1.0)
        self.min_spacing = self.parameter(props, "min_spacing", 3.0, minimum=0.1, maximum=1e6)
        self.max_spacing = self.parameter(props, "max_spacing", 40.0, minimum=0.1, maximum=1e6)
        self.gather_samples = self.parameter(
            props, "gather_samples", 512, minimum=4, maximum=1 << 16
        )
        self.max_share = self.parameter(props, "max_share", 0.05, minimum=0.001, maximum=1.0)
        self.cache_file = self.parameter(props, "cache_file", "")
        #: The records of the last render, and what each round of it did.
        self.records, self.rounds = Records.none(3), []
        slots = {key: read_slot(self.name, props, key) for key in ("next_event", "shadow_test")}
        self.fill(props, **slots)

    def parameters(self) -> dict[str, Any]:
        return {
            "accuracy": self.accuracy,
            "min_spacing": self.min_spacing,
            "max_spacing": self.max_spacing,
            "gather_samples": self.gather_samples,
            "max_share": self.max_share,
            "cache_file": self.cache_file or "none",
            **super().parameters(),
        }

    def schedule(self, scene, sensor, samples, seed):
        self._begin = time.perf_counter()
        self.records, self.rounds, self._seed = Records.none(len(mi.Spectrum())), [], seed
        return super().schedule(scene, sensor, samples, seed)

    def estimators(self, scene, sensor):
        return functools.partial(self._estimator, scene, sensor)

    def _estimator(self, scene: mi.Scene, sensor: mi.Sensor, **decisions: Any) -> Walk:
        walk = self.walk(**decisions)
        if "observer" in decisions or self.max_depth < 3 or not scene.emitters():
            return walk
        parameters = CacheParameters(self.accuracy, self.min_spacing, self.max_spacing)
        inner = replace(
            walk, max_depth=self.max_depth - 1, rr_depth=max(1, self.rr_depth - 1),
            hide_emitters=False,
        )  # fmt: skip
        gatherer = Gatherer(
            scene, inner, Strata.about(self.gather_samples), parameters.bounds,
            self.min_spacing, self.max_share, self._seed,
        )  # fmt: skip
        rounds = CacheRounds(
            scene, sensor, walk, gatherer, parameters, self._seed, self.records
        )
        rounds.run(deadline(0.5 * self.timeout, self._begin))
        self.records, self.rounds = rounds.records, rounds.rounds
        return replace(
            walk, rr_depth=0, roulette=EndsAtTheCache(self.rr_depth), mis=CameraPhases(),
            subpaths=CachedLight(rounds.final_grid(), self.max_depth, can_be_hit(scene)),
        )  # fmt: skip
