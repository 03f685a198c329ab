"""Long renders of the tests, and their images."""

from __future__ import annotations

import numpy as np

from mitsuba_ext.long_renders.batch_renderer import BatchRenderer, RenderRequest
from mitsuba_ext.long_renders.long_render import Goal, LongRender
from mitsuba_ext.long_renders.state import RenderState

#: A short render that learns.
LEARNER = "composed_path:max_depth=3,next_event=contribution"


def rendered(request: RenderRequest, state: RenderState | None = None, spp: int = 64, **options):
    renderer = BatchRenderer(request)
    render = LongRender(renderer, state or RenderState())
    render.run(Goal(spp), **options)
    return render.state


def image(state: RenderState) -> np.ndarray:
    contents = state.film.contents
    return contents[..., :3] / (contents[..., 3:4] if state.film.has_weights else state.spp)
