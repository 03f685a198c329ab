"""The task of a worker: rendering a batch. The worker keeps the scene for the next batch."""

from __future__ import annotations

import hashlib
import json
import platform
import threading
from typing import NamedTuple

import drjit as dr

from ..inputs.variants import select_variant
from ..util.errors import InputError
from .batch_renderer import BatchRenderer, RenderRequest
from .bundle import Bundle
from .folder import difference
from .state import Batch, BatchResult


class Missing(NamedTuple):
    """The answer of a worker that lacks data for a batch.

    Attributes:
        scene: Whether it lacks the scene's files or has other versions of them.
        learned: Whether it lacks the learned state.
    """

    scene: bool
    learned: bool


def digest_of(learned: bytes | None) -> str | None:
    """The digest with which a worker checks whether it already has the learned state; see
    :func:`render_batch`."""
    if learned is None:
        return None
    return hashlib.sha256(learned).hexdigest() if learned else ""


class _Kept(NamedTuple):
    request: RenderRequest
    renderer: BatchRenderer


_kept: _Kept | None = None

#: The digest of the last received learned state, and the state.
_learned: tuple[str | None, bytes | None] = (None, None)

#: Held while a batch is rendered: Dask workers have threads, and Dr.Jit uses all cores per batch.
_rendering = threading.Lock()


def render_batch(
    request: RenderRequest,
    batch: Batch,
    digest: str | None = None,
    learned: bytes | None = None,
    bundle: Bundle | None = None,
) -> BatchResult | Missing:
    """Renders a batch in this process. The scene and the learned state are sent only to workers
    that lack them: most have them from the previous batch.

    Args:
        request, batch: The render and its batch.
        digest: The digest of the learned state, from :func:`digest_of`. Empty if there was nothing
            to learn, ``None`` if this is the batch that learns.
        learned, bundle: The learned state and the scene, for a worker that lacks them.

    Returns:
        The result, or the data that this worker lacks.

    Raises:
        InputError: The scene cannot be rendered, or this process would render another image.
    """
    global _kept, _learned
    with _rendering:
        if learned:
            if digest_of(learned) != digest:
                raise InputError("the learned state was damaged in transfer to the worker")
            _learned = digest, learned
        if _kept is None or _kept.request != request:
            _kept = None  # first, because Dr.Jit compiles the methods of all living objects
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
    """Loads the scene of a request; ``None`` if the files at its paths are missing or differ."""
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
    # The maker of the bundle may have followed links, so its hash covers files with other names
    free = ["scene files hash"] if bundle else []
    if wrong := difference(json.loads(request.description), found, free):
        if bundle is None:
            return None
        raise InputError(f"the worker {platform.node()} would render another image: {wrong}")
    return renderer
