"""What a worker does: it renders a batch, and keeps the scene for the next one."""

from __future__ import annotations

import hashlib
import json
import platform
import threading
from typing import NamedTuple

import drjit as dr

from ..errors import InputError
from ..inputs.variants import select_variant
from .batch_renderer import BatchRenderer, RenderRequest
from .bundle import Bundle
from .folder import difference
from .state import Batch, BatchResult


class Missing(NamedTuple):
    """What a worker needs for a batch, and does not have.

    Attributes:
        scene: The scene's files, or the same ones.
        learned: What the integrator has learned.
    """

    scene: bool
    learned: bool


def digest_of(learned: bytes | None) -> str | None:
    """What tells a worker whether it has what was learned; see :func:`render_batch`."""
    if learned is None:
        return None
    return hashlib.sha256(learned).hexdigest() if learned else ""


class _Kept(NamedTuple):
    request: RenderRequest
    renderer: BatchRenderer


_kept: _Kept | None = None

#: What was learned last, and its digest.
_learned: tuple[str | None, bytes | None] = (None, None)

#: Held while a batch is rendered: a worker of Dask has several threads, and Dr.Jit uses all cores
#: for each batch.
_rendering = threading.Lock()


def render_batch(
    request: RenderRequest,
    batch: Batch,
    digest: str | None = None,
    learned: bytes | None = None,
    bundle: Bundle | None = None,
) -> BatchResult | Missing:
    """Renders a batch in this process. What it needs is sent only if it asks for it: most workers
    have it from the batch before.

    Args:
        digest: Of what was learned: :func:`digest_of`. Empty if there was nothing to learn,
            ``None`` if this batch is the one that learns it.
        learned, bundle: What was learned, and the scene, for a worker that has asked for it.

    Raises:
        InputError: The scene cannot be rendered, or this process would render another image.
    """
    global _kept, _learned
    with _rendering:
        if learned:
            if digest_of(learned) != digest:
                raise InputError("what was learned was damaged on its way to the worker")
            _learned = digest, learned
        if _kept is None or _kept.request != request:
            _kept = None  # Dr.Jit compiles what is alive
            if renderer := _renderer(request, bundle):
                _kept = _Kept(request, renderer)
        is_missing = Missing(_kept is None, bool(digest) and _learned[0] != digest)
        if any(is_missing):
            return is_missing
        if digest is None:
            return _kept.renderer.render(batch)
        return _kept.renderer.render(batch, _learned[1] if digest else b"")


def forget() -> None:
    """Frees the scene that this process keeps."""
    global _kept, _learned
    _kept, _learned = None, (None, None)


def _renderer(request: RenderRequest, bundle: Bundle | None) -> BatchRenderer | None:
    """``None`` if the files at the paths of the request are missing, or not the same."""
    select_variant(request.variant, request.plugins)
    if request.threads:
        dr.set_thread_count(request.threads)
    try:
        renderer = BatchRenderer(request, bundle)
    except InputError:
        if bundle or not request.description:
            raise
        return None
    if not request.description:
        return renderer
    found = json.loads(json.dumps(renderer.description(), default=str))
    # Links may have been followed there: the hash of the scene has other files
    free = ["scene files hash"] if bundle else []
    if wrong := difference(json.loads(request.description), found, free):
        if bundle is None:
            return None
        raise InputError(f"the worker {platform.node()} would render another image: {wrong}")
    return renderer
