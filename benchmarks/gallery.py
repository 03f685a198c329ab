"""Makes the gallery of the documentation: for each of our scenes, a report that compares ``path``,
the best of our other integrators, and ``auto``, at equal time.

    python benchmarks/references.py              # first, their references
    python benchmarks/gallery.py                 # all scenes: about 40 minutes
    python benchmarks/gallery.py rooms pool      # these

Reports are kept in ``out/gallery``: scenes that are there are not rendered again. The pages are
written to ``docs/gallery`` (about 20 MB, not in the repository), from where ``make docs`` takes
them.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import click
from previews import INTEGRATORS, PICTURES, SPECTRAL, WIDTHS
from references import stored

ROOT = Path(__file__).parents[1]
PAGES = ROOT / "docs" / "gallery"

#: The best of our integrators but ``auto``.
BEST = {
    **INTEGRATORS, **dict.fromkeys(["pool", "caustic", "ring"], "vcm"), "keyhole": "erpt",
}  # fmt: skip

def compared(name: str) -> list[str]:
    """The integrators of a scene: Mitsuba's or its equivalent, the best other one, and ``auto``."""
    best = BEST.get(name, "auto_path")
    text = (ROOT / "scenes" / f"{name}.xml").read_text(encoding="utf-8")
    first = "volpath" if "<medium" in text else "path"
    # Mitsuba's own do not see these
    if any(word in text for word in ("moving", "dispersive", "lightweight", "heightfield")):
        first = "composed_path"
    return [first, best, *([] if best == "auto" else ["auto"])]


def compare(name: str, seconds: float, seeds: int) -> None:
    """Renders what is missing of a scene's report."""
    out = ROOT / "out" / "gallery" / name
    if (out / "report.html").exists():
        return
    if (reference := stored(name)) is None:
        raise click.ClickException(f"{name} has no reference: run benchmarks/references.py {name}")
    width = WIDTHS.get(name, 320)
    command = [
        sys.executable, "-m", "mitsuba_ext", "compare", f"scenes/{name}.xml", *compared(name),
        "--time", f"{seconds:g}", "--seeds", str(seeds), "--size", f"{width}x180",
        "--reference", str(reference),
        "--variant", "llvm_ad_spectral" if name in SPECTRAL else "llvm_ad_rgb",
        "--out", str(out),
    ]  # fmt: skip
    subprocess.run(command, cwd=ROOT, check=False)


def caption(results: dict) -> str:
    """The efficiency of each integrator but the first, in units of the first one's."""
    (scene,) = results["scenes"]
    first, *others = scene["integrators"]
    parts = []
    for other in others:
        ratios = other["levels"][0]["ratios"] if other["levels"] else {}
        ratio = (ratios.get("efficiency") or {}).get("value")
        label = f"`{other['label']}`"
        if ratio:
            parts.append(f"{label} {ratio:.3g} ×")
        else:
            why = "failed" if other["error"] else "has less error than the reference"
            parts.append(f"{label} {why}")
    return f"In units of the efficiency of `{first['label']}`: {', '.join(parts)}"


@click.command()
@click.argument("names", nargs=-1)
@click.option("--seconds", default=5.0, show_default=True, help="For each run.")
@click.option("--seeds", default=2, show_default=True)
def main(names: tuple[str, ...], seconds: float, seeds: int) -> None:
    """Compares on the scenes NAMES (all, if none is given), and writes the pages of all scenes that
    have been compared."""
    for name in names or PICTURES:
        compare(name, seconds, seeds)
    PAGES.mkdir(exist_ok=True)
    cards = []
    for name in PICTURES:
        folder = ROOT / "out" / "gallery" / name
        if not (folder / "report.html").exists():
            continue
        shutil.copy(folder / "report.html", PAGES / f"{name}.html")
        text = caption(json.loads((folder / "results.json").read_text()))
        cards.append(
            f"## {name}\n\n![{name}](../../scenes/previews/{name}.jpg)\n\n{text}: "
            f"[flip book, error maps and numbers]({name}.html), "
            f"[the scene](../../scenes/{name}.xml)\n"
        )
    head = (
        "# Reports on all scenes\n\nOur scenes, rendered by `path` (in fog `volpath`, with things "
        "that move `composed_path`), the best of our other integrators, and `auto`, at equal time: "
        f"{seconds:g} s, {seeds} seeds. The pictures here are clean previews; each report "
        "has the renders. `benchmarks/gallery.py` makes this page.\n\n"
    )
    (PAGES / "index.md").write_text(head + "\n".join(cards), encoding="utf-8")


if __name__ == "__main__":
    main()
