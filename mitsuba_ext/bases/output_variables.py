"""The parameter ``aovs``: Mitsuba's output variables, light path expressions, light groups, and
masks."""

from __future__ import annotations

from collections.abc import Mapping

import mitsuba as mi

from ..scene.aovs import Aovs
from ..scene.expressions.notation import Expression
from ..scene.light_groups import light_groups
from ..scene.surface_names import SurfaceNames, surface_names
from ..scene.unseen import has_unseen_shapes
from ..transport.path_channels import PathChannels
from ..transport.queries.aovs import output_variables
from ..util.spectra import colour_names


class OutputVariables:
    """The channels of an integrator besides colour and alpha.

    Parameters:
        plugin: The integrator's name.
        aovs: The list (:class:`.scene.aovs.Aovs`).
        no_expressions: Why it cannot render light path expressions; empty if it can.

    Attributes:
        channels: The light path expressions of the scene that was looked at last; ``None`` if there
            are none.

    Raises:
        ValueError: The list has an error.
        NotImplementedError: It has light path expressions, which the integrator cannot render.
    """

    def __init__(self, plugin: str, aovs: str, no_expressions: str = "") -> None:
        self._plugin, self._list = plugin, Aovs.read(plugin, aovs)
        if self.has_expressions and no_expressions:
            raise NotImplementedError(
                f'"{plugin}": the parameter "aovs" has light path expressions, which it cannot '
                f"render, because {no_expressions}"
            )
        self._by_mitsuba: mi.Integrator | None = None
        if by_mitsuba := self._list.by_mitsuba:
            self._by_mitsuba = mi.load_dict({"type": "aov", "aovs": by_mitsuba})
        self.channels: PathChannels | None = None
        self._groups: list[str] | None = None
        self._names: SurfaceNames | None = None

    @property
    def masks(self) -> tuple[tuple[str, str], ...]:
        """The names and types of the masks."""
        return self._list.masks

    @property
    def has_expressions(self) -> bool:
        """Whether there are light path expressions, named passes or light groups."""
        return bool(self._list.expressions or self._list.groups)

    def look_at(self, scene: mi.Scene) -> None:
        """Reads from a scene what the channels need to know.

        Raises:
            ValueError: A name in an expression is not in the scene, or the expressions are too
                complex.
        """
        self._names = surface_names(scene) if self._list.numbers_shapes else None
        if not self.has_expressions:
            return
        self._groups = light_groups(scene)
        try:
            self.channels = PathChannels(scene, list(self._expressions().values()))
        except ValueError as error:
            raise ValueError(f'"{self._plugin}": the parameter "aovs": {error}') from None

    def names(self) -> list[str]:
        """The names of the channels: first the channels of expressions, then Mitsuba's.

        Raises:
            ValueError: They depend on the scene, and none was looked at.
        """
        return self.expression_names() + (
            self._by_mitsuba.aov_names() if self._by_mitsuba else []
        )

    def expression_names(self) -> list[str]:
        """The first of :meth:`names`, whose values come with the samples of a walk."""
        return [f"{name}.{colour}" for name in self._expressions() for colour in colour_names()]

    def ray_values(
        self, scene: mi.Scene, sampler: mi.Sampler, ray: mi.RayDifferential3f
    ) -> list[mi.Float]:
        """The values of Mitsuba's variables."""
        if self._by_mitsuba is None:
            return []
        if has_unseen_shapes(scene) or self._list.numbers_shapes:
            listed = self._list.by_mitsuba
            return output_variables(self._by_mitsuba, listed, scene, sampler, ray, self._names)
        return self._by_mitsuba.sample(scene, sampler, ray, None, mi.Bool(True))[2]

    def _expressions(self) -> Mapping[str, Expression]:
        """All expressions, including the expressions of light groups."""
        if not self._list.groups:
            return self._list.expressions
        if self._groups is None:
            raise ValueError(
                f'"{self._plugin}": "{self._list.groups[0]}:light_groups" in "aovs" has a channel '
                f"for each group of a scene, which is not known here: write a channel for each "
                f"group instead, such as \"key:C.*<L.'key'>\""
            )
        return self._list.of_groups(self._groups)
