"""Photon mapping for the scene of an integrator."""

from __future__ import annotations

from typing import Protocol

import mitsuba as mi

from ....rendering.request import Request
from ....scene.bsdfs import refuse_clear_curves
from ....scene.media import may_have_media
from ....transport.path_channels import PathChannels
from ....transport.path_decisions import NoConnections, SceneQuery
from ....transport.walk import Walk
from ..light_media import outer_medium
from ..light_side import light_emission
from ..light_walk import LightWalk
from ..merging.merging_parameters import MergingParameters
from ..merging.merging_radius import MergingRadii
from .photon_mapper import PhotonMapper


class PathIntegrator(Protocol):
    """The attributes and methods of an integrator that :func:`photon_mapper` uses."""

    name: str
    max_depth: int
    rr_depth: int
    hide_emitters: bool
    channels: PathChannels | None

    def query(self, scene: mi.Scene) -> SceneQuery:
        """How rays are intersected with the scene."""


def photon_mapper(
    integrator: PathIntegrator,
    request: Request,
    merging: MergingParameters | None = None,
    light_paths: float = 1.0,
    radii: MergingRadii | None = None,
) -> PhotonMapper:
    """The estimator of progressive photon mapping, for a scene that has lights, with the parameters
    of an integrator.

    Parameters:
        merging, light_paths: See :class:`sppm`. A few light paths measure the radii that are 0.
        radii: The radii, if they are known; ``merging`` is not used then.

    Raises:
        NotImplementedError: A light cannot emit light paths, or light passes through a curve.
    """
    scene, sensor = request.scene, request.sensor
    query = integrator.query(scene)
    refuse_clear_curves(scene, f'"{integrator.name}"')
    emission = light_emission(integrator.name, scene)
    outside = outer_medium(query, scene, sensor) if may_have_media(scene) else None
    light_walk = LightWalk(
        emission, integrator.max_depth, integrator.rr_depth, query=query, outside=outside
    )
    if radii is None:
        before = round(request.samples_before * light_paths)
        radii = merging.radii_of(scene, sensor, light_walk, False, before, True)
    walk = Walk(
        integrator.max_depth, integrator.rr_depth, integrator.hide_emitters,
        next_event=NoConnections(), query=query, channels=integrator.channels,
    )  # fmt: skip
    return PhotonMapper(walk, light_walk, radii.disk, radii.ball, light_paths)
