"""Renders the references of our scenes for ``gallery.py`` and ``equal_time_pictures.py``, in
``out/references``.

    python benchmarks/references.py --variant cuda_ad_rgb --spp 16384   # on a GPU
    python benchmarks/references.py rooms pool                          # these, on the CPU
    python benchmarks/references.py --integrator path                   # the errors of path

The last one renders with ``path`` into ``out/references/path``, for ``choices.py``: these files
hold the variance of ``path``, and their means lack what it cannot find.

Scenes that are there are not rendered again.
"""

from __future__ import annotations

import time
from pathlib import Path

import click
from previews import INTEGRATORS, PICTURES, SPECTRAL, WIDTHS

import mitsuba_ext  # noqa: F401  (before mitsuba: it chooses the LLVM library)
from mitsuba_ext.compare.references import load_reference, render_reference
from mitsuba_ext.inputs.scenes import load_scene
from mitsuba_ext.util.errors import InputError

import mitsuba as mi  # isort: skip

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "out" / "references"

#: Scenes without motion whose references light paths render with less noise than ``path``.
_LIGHT_PATHS = ("bdpt", "vcm", "erpt", "sppm")

#: The integrator of a reference, where it follows from no rule.
_EXCEPTIONS = {
    "fog": "volpath", "volume_caustic": "sppm", "keyhole": "bdpt",
    "paperweight": "bdpt",  # its spot lights shine through glass: no camera path finds them
    "spotlights": "bdpt",
    # Caustics that are seen in mirrors, or through glass or water
    "burning_glass": "vcm", "caustic": "vcm", "mirrored_lamp": "vcm", "pool": "vcm", "ring": "vcm",
    "water_glass": "vcm",
}  # fmt: skip


def integrator_of(name: str, variant: str) -> str:
    """The integrator that renders the reference of a scene."""
    best = INTEGRATORS.get(name, "auto_path")
    integrator = _EXCEPTIONS.get(name, "bdpt" if best in _LIGHT_PATHS else best)
    # On a GPU, learning costs more than it gains, but for the maps of swarm_path
    is_plain = "cuda" in variant and integrator == "auto_path"
    return "composed_path" if is_plain else integrator


def stored(name: str, integrator: str = "") -> Path | None:
    """The file of the reference of a scene, if there is one: that with the most samples. Of those
    that ``integrator`` has rendered, if it is given."""
    found = (FOLDER / integrator).glob(f"{name}_{WIDTHS.get(name, 320)}x180_*spp.exr")
    return max(found, key=lambda path: load_reference(path).spp or 0, default=None)


@click.command()
@click.argument("names", nargs=-1)
@click.option("--variant", default="llvm_ad_rgb", show_default=True)
@click.option("--spp", default=1024, show_default=True, help="For light paths, a quarter on a GPU.")
@click.option("--integrator", "other", default="", help="Render with this one.")
@click.option("--limit", default=1e9, help="Begin none after so many seconds.")
def main(names: tuple[str, ...], variant: str, spp: int, other: str, limit: float) -> None:
    """Renders the references of the scenes NAMES (all, if none is given)."""
    folder = FOLDER / other
    folder.mkdir(parents=True, exist_ok=True)
    begin = time.perf_counter()
    for name in names or PICTURES:
        if stored(name, other) is not None or time.perf_counter() - begin > limit:
            continue
        mi.set_variant(variant.replace("rgb", "spectral") if name in SPECTRAL else variant)
        scene = load_scene(ROOT / "scenes" / f"{name}.xml", (WIDTHS.get(name, 320), 180))
        integrator = other or integrator_of(name, variant)
        samples = spp // 4 if "cuda" in variant and integrator in _LIGHT_PATHS else spp
        try:
            reference = render_reference(scene, samples, folder, integrator)
        except InputError as error:
            print(f"{name}: {error}", flush=True)
            continue
        print(
            f"{name}: {integrator}, {reference.spp} spp, relMSE {reference.noise:.2g}, "
            f"{time.perf_counter() - begin:.0f} s since the start",
            flush=True,
        )


if __name__ == "__main__":
    main()
