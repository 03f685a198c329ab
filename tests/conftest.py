"""Fixtures for tests that render: the variant, the folder of scenes, and a clean-up per module."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from pathlib import Path

import pytest

import mitsuba_ext  # noqa: F401  (chooses an LLVM library that works: before drjit and mitsuba)

import drjit as dr  # isort: skip
import mitsuba as mi  # isort: skip

DEFAULT_VARIANT = "llvm_ad_rgb"


@pytest.fixture
def variant(request: pytest.FixtureRequest) -> Iterator[str]:
    """Selects a variant, ``llvm_ad_rgb`` unless the test is parametrised (``indirect=True``).

    Modules that render name it once: ``pytestmark = pytest.mark.usefixtures("variant")``.
    """
    name = getattr(request, "param", DEFAULT_VARIANT)
    mi.set_variant(name)
    mi.set_log_level(mi.LogLevel.Warn)
    yield name
    if name != DEFAULT_VARIANT:
        _clean_up()
        mi.set_variant(DEFAULT_VARIANT)


@pytest.fixture(scope="session")
def scenes() -> Path:
    """The folder of our scene files."""
    return Path(__file__).parents[1] / "scenes"


@pytest.fixture(scope="module", autouse=True)
def clean_up_after_module() -> Iterator[None]:
    """Frees kernels and memory, so that a long run stays as small as a short one."""
    yield
    if mi.variant() is not None:
        _clean_up()


def _clean_up() -> None:
    gc.collect()
    dr.sync_thread()
    dr.flush_kernel_cache()
    dr.flush_malloc_cache()
