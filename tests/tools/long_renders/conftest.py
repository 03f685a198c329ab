"""Fixtures for long renders."""

from __future__ import annotations

import pytest

from mitsuba_ext.long_renders.batch_renderer import RenderRequest


@pytest.fixture
def request_of(make_scene):
    def make(specification: str | None = None, **options) -> RenderRequest:
        return RenderRequest(str(make_scene()), specification=specification, **options)

    return make
