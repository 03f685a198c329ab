"""What integrators with Markov chains of light paths have in common."""

from __future__ import annotations

from typing import Any

import mitsuba as mi

from ..estimators.chains.path_space.mutations import Mutations, Switches
from ..estimators.chains.path_space.space import PathSpace
from ..estimators.chains.path_target import PathTarget
from ..estimators.light_paths.light_side import LightSide
from ..planning.technique import Setting
from ..rendering.stages import OneStage
from ..scene.bsdfs import refuse_clear_curves
from ..transport.path_program import PathProgram
from ..transport.without_lengths import WithoutLengths

#: Segments of the longest paths that chains sample: the memory of each chain grows with it.
MOST = 32

#: The parameters that switch mutations, and the attributes of :class:`Switches`.
_SWITCHES = {
    "bidirectional_mutation": "bidirectional",
    "lens_perturbation": "lens",
    "multi_chain_perturbation": "multi_chain",
    "caustic_perturbation": "caustic",
}


def read_switches(integrator: Any, props: mi.Properties, **defaults: bool) -> Switches:
    """Reads the parameters that switch mutations. ``defaults`` are by attribute of
    :class:`Switches`; a mutation that is not named there is on by default."""
    chosen = {
        name: integrator.parameter(props, key, defaults.get(name, True))
        for key, name in _SWITCHES.items()
    }
    return Switches(**chosen)


def path_target(integrator: Any, setting: Setting, switches: Switches) -> PathTarget | None:
    """The target distribution of chains of paths; ``None`` if no path is left for them to find."""
    scene, sensor = setting.scene, setting.sensor
    least, most = _least(integrator), min(setting.max_depth, MOST)
    if not scene.emitters() or most < least:
        return None
    refuse_clear_curves(scene, f'"{integrator.name}"')
    side = LightSide.of(integrator.name, scene, sensor)
    # The densities of chains of paths are per solid angle at the sensor
    connectable = None if side.sensor is None or side.sensor.is_parallel else side.sensor
    space = PathSpace(
        scene, sensor, side.emission, connectable, integrator.query(scene), setting.spp,
        least, most, integrator.hide_emitters,
    )  # fmt: skip
    return PathTarget(Mutations(space, switches))


def camera_samples(integrator: Any, setting: Setting) -> OneStage:
    """The camera samples: they find direct light, and all light on paths that are longer than
    those that chains sample."""
    program = WithoutLengths(PathProgram(), _least(integrator), MOST)
    return OneStage(integrator.composed_walk(setting, setting.max_depth, program))


def _least(integrator: Any) -> int:
    """Segments of the shortest paths that chains sample."""
    if integrator.finds_direct:
        return 3
    return 2 if integrator.hide_emitters else 1
