"""Compares integrators by speed and error. The equivalent of ``mitsuba-ext compare`` in Python::

    import mitsuba_ext
    import mitsuba as mi
    from mitsuba_ext import compare

    mi.set_variant("llvm_ad_rgb")
    comparison = compare.Comparison(
        ["scenes/door_ajar.xml", "scenes/rooms.xml"],
        ["path", "neepp:grid=32", {"type": "neepp", "rejection": True}],
        compare.equal_time(10),
        folder="out/doors",
    )
    results = comparison.run()          # also out/doors/results.json and report.html
    compare.show(results)               # tables; a notebook shows ``results`` itself as one
"""

from __future__ import annotations

from ..images.flip import mean_flip
from ..images.image_files import read_exr, write_exr
from ..images.metrics import Errors, errors, reference_noise, relative_mse
from ..images.reading import read_image
from ..inputs.scene_changes import SceneChanges
from ..inputs.scenes import LoadedScene, load_scene
from ..inputs.specifications import NamedIntegrator, make_named
from ..util.errors import InputError
from .budgets import Budget, equal_samples, equal_time, sweep, until
from .comparison import Comparison, SceneSetup
from .contenders import Contender
from .experiment import Experiment
from .intervals import Estimate
from .notebook import Results
from .progress import Step
from .references import Reference, load_reference, render_reference
from .report import write_report
from .runs import Run
from .tables import show

__all__ = [
    "Budget",
    "Comparison",
    "Contender",
    "Errors",
    "Estimate",
    "Experiment",
    "InputError",
    "LoadedScene",
    "NamedIntegrator",
    "Reference",
    "Results",
    "Run",
    "SceneChanges",
    "SceneSetup",
    "Step",
    "equal_samples",
    "equal_time",
    "errors",
    "load_reference",
    "load_scene",
    "make_named",
    "mean_flip",
    "read_exr",
    "read_image",
    "reference_noise",
    "relative_mse",
    "render_reference",
    "show",
    "sweep",
    "until",
    "write_exr",
    "write_report",
]
