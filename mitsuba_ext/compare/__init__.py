"""Comparing integrators by speed and error, from a notebook as from ``mitsuba-ext compare``::

    import mitsuba as mi
    import mitsuba_ext
    from mitsuba_ext import compare

    mi.set_variant("llvm_ad_rgb")
    scene = compare.load_scene("scene.xml", size=(180, 180), keep_integrator=False)
    experiment = compare.Experiment(scene, ["path", "neepp:max_depth=6"], spp=64)
    experiment.run(compare.load_reference("reference.exr", scene.size))
    compare.results(experiment)  # or rich.print(compare.table(experiment))
"""

from __future__ import annotations

from ..scenes import InputError, LoadedScene, load_scene
from .experiment import Contender, Experiment, Run
from .images import read_exr, write_exr
from .metrics import Errors, errors, reference_noise, relative_mse
from .references import Reference, load_reference, render_reference
from .tables import image_writer, results, table, write_results

__all__ = [
    "Contender",
    "Errors",
    "Experiment",
    "InputError",
    "LoadedScene",
    "Reference",
    "Run",
    "errors",
    "image_writer",
    "load_reference",
    "load_scene",
    "read_exr",
    "reference_noise",
    "relative_mse",
    "render_reference",
    "results",
    "table",
    "write_exr",
    "write_results",
]
