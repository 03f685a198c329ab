"""Renders the references of our scenes for ``gallery.py`` and ``equal_time_pictures.py``, in
``out/references``.

    python benchmarks/references.py --variant cuda_ad_rgb   # on a GPU: about ten minutes
    python benchmarks/references.py rooms pool              # these, on the CPU

Scenes that are there are not rendered again.
"""

from __future__ import annotations

import time
from pathlib import Path

import click
from previews import INTEGRATORS, PICTURES, SPECTRAL, WIDTHS

import mitsuba_ext  # noqa: F401  (before mitsuba: it chooses the LLVM library)
from mitsuba_ext.compare.references import Reference, load_reference, render_reference
from mitsuba_ext.inputs.scenes import LoadedScene, load_scene

import mitsuba as mi  # isort: skip

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "out" / "references"

#: Scenes without motion whose references light paths render with less noise than ``path``.
_LIGHT_PATHS = ("bdpt", "vcm", "erpt", "sppm")

#: The integrator of a reference, where it follows from no rule.
_EXCEPTIONS = {
    "fog": "volpath", "volume_caustic": "sppm",
    "paperweight": "bdpt",  # its spot lights shine through glass: no camera path finds them
}

#: Samples per pixel of the render that tells how long a sample takes.
_PILOT_SPP = 64


def integrator_of(name: str) -> str:
    """The integrator that renders the reference of a scene."""
    best = INTEGRATORS.get(name, "auto_path")
    return _EXCEPTIONS.get(name, "bdpt" if best in _LIGHT_PATHS else best)


def stored(name: str) -> Path | None:
    """The file of the reference of a scene, if there is one: that with the most samples."""
    found = FOLDER.glob(f"{name}_{WIDTHS.get(name, 320)}x180_*spp.exr")
    return max(found, key=lambda path: load_reference(path).spp or 0, default=None)


def rendered(scene: LoadedScene, integrator: str, seconds: float) -> Reference:
    """A reference with as many samples as fit into a time, a power of two."""
    render_reference(scene, _PILOT_SPP, FOLDER, integrator)  # compiles the kernels
    pilot = render_reference(scene, 2 * _PILOT_SPP, FOLDER, integrator)
    pilots = [pilot.path, pilot.path.with_name(pilot.path.name.replace("_128spp", "_64spp"))]
    spp = 8 * _PILOT_SPP
    while 2 * spp <= 2 * _PILOT_SPP * seconds / float(pilot.metadata["seconds"]):
        spp *= 2
    reference = render_reference(scene, spp, FOLDER, integrator)
    for path in pilots:
        path.unlink()
    return reference


@click.command()
@click.argument("names", nargs=-1)
@click.option("--variant", default="llvm_ad_rgb", show_default=True)
@click.option("--seconds", default=60.0, show_default=True, help="For each reference.")
@click.option("--limit", default=1e9, help="Begin none after so many seconds.")
def main(names: tuple[str, ...], variant: str, seconds: float, limit: float) -> None:
    """Renders the references of the scenes NAMES (all, if none is given)."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    begin = time.perf_counter()
    for name in names or PICTURES:
        if stored(name) is not None or time.perf_counter() - begin > limit:
            continue
        backend = variant.split("_")[0]
        mi.set_variant(f"{backend}_ad_spectral" if name in SPECTRAL else variant)
        scene = load_scene(ROOT / "scenes" / f"{name}.xml", (WIDTHS.get(name, 320), 180))
        try:
            reference = rendered(scene, integrator_of(name), seconds)
        except mitsuba_ext.errors.InputError as error:
            print(f"{name}: {error}", flush=True)
            continue
        print(
            f"{name}: {integrator_of(name)}, {reference.spp} spp, relMSE {reference.noise:.2g}, "
            f"{time.perf_counter() - begin:.0f} s since the start",
            flush=True,
        )


if __name__ == "__main__":
    main()
