"""The base class of integrators with Markov chains.

This file is executed once per variant (see ``registry.py``): its base class is variant-bound.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from ..estimators.chains.path_target import PathTarget
from ..estimators.chains.render import ChainRender
from ..estimators.chains.target import ImageTarget
from ..planning.learned_file import LearnedFile
from ..planning.technique import Setting, decisions_of
from ..rendering.batches import sample_count
from ..rendering.camera import check_takes_splats
from ..rendering.camera import develop as develop_film
from ..rendering.interrupts import deferred_interrupt, interrupted
from ..rendering.request import Request
from ..rendering.stages import Learning, OneStage
from ..scene.fingerprint import sensor_digest
from ..startup.registry import variant_bound
from ..transport.decisions import Decisions
from ..transport.estimator import CameraRays, Estimator, Sample
from ..transport.frozen import with_recordings
from ..transport.path_program import PathProgram
from ..transport.walk import Walk
from ..util.parameters import MOST_SPP
from .learned_state import check_target, file_of
from .walk_integrator import WalkIntegrator

#: The largest share of the time limit for camera samples.
_CAMERA_SHARE = 0.25

#: Camera samples per pixel, at least (as in Mitsuba 0.6), and their share of ``spp``: a sample of
#: direct light takes a fraction of the time of a mutation.
_CAMERA_SAMPLES, _DIRECT_SHARE = 16, 0.25


@dataclass
class _OnlyAlpha:
    """Camera samples whose radiance is set to zero."""

    estimator: Estimator

    can_be_frozen = True

    def __call__(self, scene, sampler, rays: CameraRays, active) -> Sample:
        sample = self.estimator(scene, sampler, rays, active)
        return replace(sample, L=dr.zeros(mi.Spectrum, dr.width(sample.L)))


@variant_bound
class ChainIntegrator(WalkIntegrator):
    """An integrator that renders direct light with camera samples, and the rest with Markov chains.

    .. pluginparameters::

     * - direct_samples
       - |int|
       - Camera samples per pixel for visible lights and direct light, which :monosp:`path` finds
         well; the chains find the rest. 0 stands for a quarter of ``spp``, and 16 at least; −1
         leaves all light to the chains. (Default: 0)
     * - chain_file
       - |string|
       - A file. If it does not exist, the state of the chains and the image that they have found
         are saved to it in the end, also after Ctrl-C or a time limit. If it exists, the same
         render (scene, sensor, seed, parameters) continues from it, up to ``spp``, which may be
         higher than before. Where chains find the whole image (:class:`pssmlt`, :class:`mlt`), the
         estimate of its mean brightness is taken from the first render. (Default: none)
     * - (Common parameters)
       - |several|
       - Those of :class:`WalkIntegrator`: max_depth, rr_depth, hide_emitters, timeout, aovs,
         checkpoint.

    Attributes:
        missing_in_samples: Why its camera samples alone are not its image.
        chain_file: The file in which the state of a render is saved; empty for none.
        direct_samples: Camera samples per pixel; 0 for a number that depends on ``spp``, −1 where
            chains find all light.
    """

    missing_in_samples = "its chains find the rest"

    no_expressions = (
        "a Markov chain only knows the brightness of its whole path; use "
        '"composed_path", "bdpt" or "vcm"'
    )
    sees_media = False

    #: False, as the weights in the film count its camera samples, and not its mutations.
    film_counts_samples = False

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.direct_samples = self.parameter(
            props, "direct_samples", 0, minimum=-1, maximum=1 << 20
        )
        self.chain_file = self.parameter(props, "chain_file", "")
        if self.chain_file and self.checkpoint:
            raise ValueError(
                f'"{self.name}": "chain_file" and "checkpoint" exclude each other: the first keeps '
                f"one long render, the second begins chains in each batch"
            )

    def read_luminance_samples(self, props: mi.Properties) -> int:
        """Reads the parameter ``luminance_samples``."""
        return self.parameter(props, "luminance_samples", 100_000, minimum=1, maximum=1 << 26)

    def chain_render(
        self, target: ImageTarget | PathTarget, request: Request, *render: Any
    ) -> ChainRender:
        """Makes the render of the chains. The parameters are those of :class:`ChainRender` after
        the integrator."""
        raise NotImplementedError

    def state_file(self, target: ImageTarget | PathTarget, seed: int) -> LearnedFile | None:
        """The file for the state of a render; ``None`` without the parameter ``chain_file``.

        Raises:
            ValueError: The file cannot be written.
        """
        if not self.chain_file:
            return None
        check_target(self.name, "chain_file", self.chain_file)
        sensor, film = target.sensor, target.sensor.film()
        made_by = {
            **self.parameters(), "chain_file": "", "max_depth": self.max_depth,
            "rr_depth": self.rr_depth, "hide_emitters": self.hide_emitters, "seed": seed,
            "variant": mi.variant(), "size": film.crop_size(), "offset": film.crop_offset(),
            "filter": film.rfilter(), "sensor": sensor_digest(sensor),
        }  # fmt: skip
        described = (f"{key} = {' '.join(str(value).split())}" for key, value in made_by.items())
        made_by = ", ".join(described)
        return file_of(self.name, "chain_file", self.chain_file, target.scene, made_by)

    def target(self, setting: Setting) -> ImageTarget | PathTarget | None:
        """The target distribution of the chains; ``None`` if no path is left for them to find."""
        raise NotImplementedError

    @property
    def finds_direct(self) -> bool:
        """Whether camera samples find direct light."""
        return self.direct_samples >= 0

    def schedule(
        self, request: Request, samples: tuple[int, ...], learning: Learning
    ) -> OneStage:
        """The stage of the camera samples."""
        setting = self.setting(request, sum(samples))
        if self.finds_direct:
            return OneStage(self.composed_walk(setting, min(self.max_depth, 2)))
        return OneStage(_OnlyAlpha(self.composed_walk(setting, min(self.max_depth, 1))))

    def setting(self, request: Request, spp: int) -> Setting:
        """The setting of ``spp`` samples per pixel."""
        return Setting(
            request.scene, request.sensor, request.seed, self.max_depth, self.rr_depth, spp,
            is_timed=request.is_timed,
        )  # fmt: skip

    def composed_walk(
        self, setting: Setting, max_depth: int, program: PathProgram | None = None
    ) -> Walk:
        """A walk with this integrator's decisions; ``program`` follows its paths."""
        given = Decisions(query=self.query(setting.scene))
        walk = self.walk(decisions_of(self.slots, setting, given))
        return replace(walk, max_depth=max_depth, program=program or PathProgram())

    def render_once(self, request: Request) -> mi.TensorXf:
        start, sensor = time.perf_counter(), request.sensor
        try:
            check_takes_splats(sensor.film())
        except NotImplementedError as error:
            raise NotImplementedError(f'"{self.name}": {error}') from None
        request = replace(request, spp=self._check_spp(request.spp, sensor))

        def attempt() -> bool:
            return self._render_all(request, start)

        is_interrupted = with_recordings(request.scene, sensor, attempt)
        self.statistics.seconds = time.perf_counter() - start
        image = develop_film(sensor.film(), request.develop, request.evaluate)
        if is_interrupted:
            raise interrupted(self.name)
        return image

    def _render_all(self, request: Request, start: float) -> bool:
        """Renders the image into the film. Returns True if the render was interrupted."""
        target = self.target(self.setting(request, request.spp))
        self._render_camera_samples(request, target is not None)
        statistics, camera_spp = self.statistics, self.statistics.spp
        if target is None and not statistics.learned:
            statistics.learned = (
                f"there is nothing for chains to find: the image is {camera_spp} camera samples "
                f"per pixel"
            )
        if target is None or self.is_cancelled:
            return False
        chains = self.chain_render(target, request, camera_spp, statistics, start)
        with deferred_interrupt() as interrupt:
            chains.run(interrupt)
        return interrupt.is_set()

    def _check_spp(self, spp: int, sensor: mi.Sensor) -> int:
        if not 0 <= spp <= MOST_SPP:
            raise ValueError(
                f'"{self.name}": spp is {spp}; it must be 1 to {MOST_SPP}, or 0 for as many '
                f"as the sampler says"
            )
        return spp or sample_count(sensor, 0)

    def _render_camera_samples(self, request: Request, has_chains: bool) -> None:
        """Renders them into the film, and sets ``self.statistics``. ``request`` asks for the whole
        render, chains included."""
        count = _CAMERA_SAMPLES
        if self.finds_direct:
            count = self.direct_samples or max(count, int(_DIRECT_SHARE * request.spp))
        request = replace(request, spp=count, develop=False, evaluate=False)
        if has_chains:
            timeout = request.timeout * _CAMERA_SHARE
            request = replace(request, timeout=timeout, progress=None, watch=None)
        super().render_once(request)

    def sample(self, scene, sampler, ray, medium=None, active=True) -> Any:
        raise NotImplementedError(
            f'"{self.name}": chains have no single samples: it cannot be nested in an integrator '
            f'that asks for those, such as "moment" or "aov"; "variance" can hold it, and it has a '
            f'parameter "aovs" of its own'
        )
