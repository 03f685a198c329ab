"""A learner of your own: choose lights by the light that pilot connections to each have found.

    mitsuba-ext compare scenes/window.xml --plugin examples/own_learner.py --size 160x90 \\
        --spp 64 path "composed_path:next_event=[proven_lights],pilot_spp=8"

Unlike ``learned_lights``, this one has the same probabilities everywhere in the scene.
"""

from __future__ import annotations

from collections.abc import Mapping

import mitsuba_ext  # noqa: F401  (before mitsuba: it chooses the LLVM library)
from mitsuba_ext.bases.decision_plugin import register
from mitsuba_ext.planning.learner import Learner, Pilot
from mitsuba_ext.planning.technique import Setting, Technique
from mitsuba_ext.scene.lights.light_cells import LightCells
from mitsuba_ext.transport.light_table import LightTable, OneRow
from mitsuba_ext.util.spectra import brightness

import drjit as dr  # isort: skip
import mitsuba as mi  # isort: skip
import numpy as np  # isort: skip

#: The share of the choices that stays uniform: a light that no pilot sample saw may still
#: contribute.
UNIFORM_SHARE = 0.2

#: Sums are integers in this unit, so that the order in which threads add does not change them.
UNIT = 2.0**20


class ProvenLights(Learner):
    """Sums up, for each light, the contributions of connections to the image."""

    def start(self, scene: mi.Scene, p: mi.Point3f, n: mi.Normal3f) -> LightTable:
        self._cells = LightCells(scene, None)
        self._sums = dr.zeros(mi.UInt64, self._cells.count)
        dr.eval(self._sums)
        return self._table(np.ones(self._cells.count))

    def connection(self, choice, vertex, ds, contribution, value, pdf, visible, tested) -> None:
        """Called for each connection whose shadow ray was traced; ``value`` is its contribution."""
        brought = dr.minimum(brightness(value), 1e3)
        dr.scatter_add(self._sums, mi.UInt64(brought * UNIT), choice.cell, visible)

    def learn(self, pilot: Pilot) -> LightTable:
        return self._table(self._sums.numpy().astype(float))

    def state(self) -> dict[str, np.ndarray]:
        """The arrays from which a later render restores the same probabilities."""
        return {"sums": self._sums.numpy()}

    def restore(self, scene: mi.Scene, state: dict[str, np.ndarray]) -> LightTable:
        self._cells = LightCells(scene, None)
        return self._table(state["sums"].astype(float))

    def _table(self, sums: np.ndarray) -> LightTable:
        learned = sums / sums.sum() if sums.sum() > 0 else np.full(len(sums), 1 / len(sums))
        self._shares = (1 - UNIFORM_SHARE) * learned + UNIFORM_SHARE / len(sums)
        return LightTable(OneRow(), self._cells, mi.Float(self._shares.tolist()))

    def __str__(self) -> str:
        return f"proven lights: the most likely one has {self._shares.max():.0%} of the choices"


class ProvenLightChoice(Technique):
    """Makes the learner of a render, from 8 samples per pixel unless ``pilot_spp`` is given."""

    name, slots, pilot_spp = "proven_lights", ("next_event",), 8

    def can_learn(self, scene: mi.Scene, spp: int) -> bool:
        return spp > 0 and len(scene.emitters()) > 1

    def learner(self, setting: Setting, others: Mapping[str, Learner]) -> Learner | None:
        return ProvenLights() if self.can_learn(setting.scene, setting.pilot_spp) else None


register(ProvenLightChoice)
