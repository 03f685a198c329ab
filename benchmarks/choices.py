"""Is what learns at least as efficient as ``path``, and as the best of the others, in renders of a
given time?

    python benchmarks/choices.py scenes/window.xml scenes/open.xml --seconds 5 --out out/choices

All integrators take the same number of samples: as many as ``path`` takes in the given time. Error
of a pixel: the variance between the seeds, over (median² + 0.01 · (mean of the image)²). The median
is that of all seeds of the integrators that have light paths, and should be one of three images or
more. To the errors of the others, the squared difference of their mean to that of these integrators
is added, corrected for noise: it shows what light they miss. (The bias of merging is not shown, nor
is light that only some of those with light paths find.) Errors are means over all pixels but the
0.1 % with the largest ones, and in brackets over all. Time: the median over the seeds but the
first, which compiles; learning, and what other seeds compile, included.

With ``--references``, scenes of ours whose reference ``references.py`` has rendered, and scenes
with a reference of ``path`` beside them, have the size and ``max_depth`` of that reference. Their
errors are squared differences to it, so that one seed is enough: a render of fewer samples comes
before it, and compiles most kernels. The error of ``path`` over all pixels is the expected one,
where ``references.py --integrator path`` has measured its variance: the brightest samples of a
single render would decide about it.

``--choices 10`` renders no images: it shows what ten seeds choose for renders of that time.

``--cpu`` measures the time of all cores instead of the wall clock, for machines that do other work.
It favours what runs on all cores. ``--table`` prints the table of all results in the folder. All
must have been measured with the same clock.
"""

from __future__ import annotations

import collections
import json
import statistics
import time
from fractions import Fraction
from pathlib import Path
from typing import Any

import click
from references import stored

import mitsuba_ext  # noqa: F401  (chooses an LLVM library that works: before mitsuba)

import drjit as dr  # isort: skip
import mitsuba as mi  # isort: skip
import numpy as np  # isort: skip

from mitsuba_ext.compare.references import Reference, load_reference  # isort: skip
from mitsuba_ext.inputs.scenes import load_scene, scene_name  # isort: skip

#: The first one is that to which the others are compared.
INTEGRATORS = ("path", "auto_path", "bdpt", "vcm", "auto")

#: Integrators whose mean is trusted: they find the light that camera paths miss.
TRUSTED = ("bdpt", "vcm", "auto")

_MAX_DEPTH = 6

#: References that lie beside the files of scenes.
_BESIDE = "reference_path_*.exr"


def _render(scene: mi.Scene, integrator: mi.Integrator, spp: int, seed: int):
    begin = time.perf_counter(), time.process_time()
    image = mi.render(scene, integrator=integrator, spp=spp, seed=seed).numpy()
    taken = time.perf_counter() - begin[0], time.process_time() - begin[1]
    return image[..., :3].astype(float), taken


def _choice(effects: dict[str, dict[str, Any]]) -> str:
    """What was kept, in a few words."""
    words = []
    for slot, effect in effects.items():
        if not effect["is_kept"]:
            continue
        if slot == "light_paths":
            number = effect["connections"]
            connects = "" if number == 1 else f", {number or 'no'} connections"
            merges = ", merging" if effect["merges"] else ""
            count = Fraction(effect["light_paths"])
            paths = "light path" if count == 1 else "light paths"
            words.append(f"{count} {paths}{connects}{merges}")
        else:
            words.append({"next_event": "lights", "directions": "guide"}.get(slot, slot))
    return " + ".join(words) or "path"


def _predicted(effects: dict[str, dict[str, Any]], figure: str = "trimmed_variance") -> float:
    """The efficiency that the pilots predict for the last stage, in units of that of ``path``.
    ``figure`` is that of light paths: without the brightest pixels, or ``variance``."""
    kept = [e for e in effects.values() if e["is_kept"] and "variance" in e]
    variances = [e.get(figure, e["variance"]) * e.get("time", 1.0) for e in kept]
    return float(np.prod([1 / max(x, 1e-9) for x in variances]))


def errors(images: dict[str, list[np.ndarray]]) -> dict[str, np.ndarray]:
    """The squared relative error of each pixel, for each integrator, in ascending order."""
    mean = {name: np.mean(some, axis=0) for name, some in images.items()}
    noise = {name: np.var(some, axis=0, ddof=1) for name, some in images.items()}
    trusted = [name for name in TRUSTED if name in images] or list(images)
    # In a mean, sparks would make their own pixels bright, whose errors then count less
    image = np.median(np.concatenate([images[name] for name in trusted]), axis=0)
    scale = image**2 + 0.01 * image.mean() ** 2
    truth = np.mean([mean[name] for name in trusted], axis=0)
    noise_of_truth = np.sum([noise[name] for name in trusted], axis=0) / len(trusted) ** 2
    found = {}
    for name, some in images.items():
        error = noise[name]
        if name not in trusted:
            missed = (mean[name] - truth) ** 2 - (noise[name] + noise_of_truth) / len(some)
            error = error + missed
        found[name] = np.sort((error / scale).mean(axis=2), axis=None)
    return found


def errors_to(
    reference: Reference, images: dict[str, list[np.ndarray]]
) -> dict[str, np.ndarray]:
    """As :func:`errors`, by the difference to a reference, corrected for its noise."""
    squares = {name: np.square(some - reference.mean).mean(axis=0) for name, some in images.items()}
    return {name: np.sort(_relative(x, reference), axis=None) for name, x in squares.items()}


def _relative(squared_errors: np.ndarray, reference: Reference) -> np.ndarray:
    noise = 0 if reference.variance is None else np.nan_to_num(reference.variance)
    scale = reference.mean**2 + 0.01 * reference.mean.mean() ** 2
    return ((squared_errors - noise) / scale).mean(axis=2)


def expected_error(reference: Reference, of_path: Reference, spp: int) -> float:
    """The relative squared error of all pixels that a render of ``path`` is expected to have: its
    variance, and what it cannot find."""
    variance = np.nan_to_num(of_path.variance)
    missed = np.square(of_path.mean - reference.mean) - variance
    return float(_relative(variance * of_path.spp / spp + missed, reference).mean())


def _samples_of_path(
    scene: mi.Scene, seconds: float, cpu: bool = True, max_depth: int = _MAX_DEPTH
) -> int:
    """How many samples of each pixel ``path`` takes in the given time."""
    path = mi.load_dict({"type": "path", "max_depth": max_depth})
    for _ in range(3):
        wall, busy = _render(scene, path, 16, 1)[1]
    return max(8, round(16 * seconds / (busy / dr.thread_count() if cpu else wall)))


def compare(
    file: Path,
    seconds: float,
    seeds: int,
    size: tuple[int, int],
    names: tuple[str, ...],
    cpu: bool,
    stored_file: Path | None = None,
) -> dict[str, Any]:
    """The result for one scene: times, errors, choices."""
    max_depth, reference = _MAX_DEPTH, load_reference(stored_file) if stored_file else None
    loaded = load_scene(file, reference.size if reference else size)
    scene = loaded.scene
    if reference is not None:
        max_depth = reference.metadata.get("max_depth", loaded.settings["max_depth"])
    made = {name: mi.load_dict({"type": name, "max_depth": max_depth}) for name in names}
    spp = _samples_of_path(scene, seconds, cpu, max_depth)
    if reference is not None:
        for integrator in made.values():
            _render(scene, integrator, max(20, spp // 8), 1)
    images, times = {name: [] for name in made}, {name: [] for name in made}
    effects: dict[str, list[dict[str, Any]]] = {name: [] for name in made}
    refused = {}
    for seed in range(seeds):
        for index, (name, integrator) in enumerate(made.items()):
            try:
                # Of equal seeds, images would be correlated
                image, taken = _render(scene, integrator, spp, 1000 * seed + 3 + 101 * index)
            except (RuntimeError, NotImplementedError) as error:
                refused[name] = str(error)
                continue
            images[name].append(image)
            times[name].append(taken)
            effects[name].append(integrator.statistics.effects if name != "path" else {})
    images = {name: some for name, some in images.items() if len(some) == seeds}
    found = errors_to(reference, images) if reference else errors(images)
    # The first one compiles
    first = min(1, seeds - 1)
    result = {}
    for name, error in found.items():
        result[name] = {
            "time": statistics.median(wall for wall, _ in times[name][first:]),
            "cpu": statistics.median(busy for _, busy in times[name][first:]),
            "error": error[: int(0.999 * len(error))].mean(), "error_of_all": error.mean(),
            "effects": effects[name],
        }  # fmt: skip
    of_path = stored(scene_name(file), "path")
    if reference is not None and of_path is not None and "path" in result:
        expected = expected_error(reference, load_reference(of_path), spp)
        result["path"]["error_of_all"] = expected
    return {"spp": spp, "seconds": seconds, "cpu": cpu, "integrators": result, "refused": refused}


def _reference_of(file: Path) -> Path | None:
    """The file of the reference of a scene, if there is one."""
    return stored(scene_name(file)) or next(file.parent.glob(_BESIDE), None)


def choices(
    file: Path, seconds: float, seeds: int, size: tuple[int, int], name: str = "auto"
) -> collections.Counter[str]:
    """What ``seeds`` seeds choose, in renders of as many samples as ``path`` takes in the given
    time. They end when all has been learned."""
    scene = load_scene(file, size).scene
    spp = _samples_of_path(scene, seconds)
    integrator = mi.load_dict({"type": name, "max_depth": _MAX_DEPTH})
    found = collections.Counter()
    for seed in range(seeds):
        integrator.progress = lambda _done: integrator.statistics.learned and integrator.cancel()
        integrator.render(scene, seed=seed, spp=spp)
        found[_choice(integrator.statistics.effects)] += 1
    return found


def gain(result: dict[str, Any], name: str, key: str = "error") -> float:
    """The efficiency of an integrator in units of that of the first one."""
    made = result["integrators"]
    first, other = next(iter(made.values())), made[name]
    clock = "cpu" if result["cpu"] else "time"
    return first[key] * first[clock] / max(other[key] * other[clock], 1e-300)


def line(scene: str, result: dict[str, Any]) -> str:
    """A line of the table."""
    gains = {name: gain(result, name) for name in result["integrators"]}
    cells = [
        f"{name} {gains[name]:.3g} ({gain(result, name, 'error_of_all'):.3g})" for name in gains
    ]
    return f"{scene}, {result['spp']} spp: {', '.join(cells)}"


def table(folder: Path, name: str = "auto") -> None:
    """Prints a table of all results in a folder for one integrator: the best of the others, its own
    efficiency, what it chose, and what it predicted; these figures with all pixels; a summary."""
    results = {file.stem: json.loads(file.read_text()) for file in folder.glob("*.json")}
    results = dict(sorted(results.items(), key=lambda item: -gain(item[1], name)))
    print("| scene | samples | `auto` chose | efficiency | predicted | best other |")
    print("|---" * 6 + "|")
    all_pixels = ["| scene | efficiency | all pixels | predicted | all pixels |", "|---" * 5 + "|"]
    of_path, of_best, honest = [], [], []
    for scene, result in results.items():
        others = {n: gain(result, n) for n in result["integrators"] if n not in (name, "path")}
        best = max(others, key=lambda n: others[n])
        own, of_all = gain(result, name), gain(result, name, "error_of_all")
        effects = result["integrators"][name]["effects"]
        predicted = statistics.median(map(_predicted, effects))
        of_whole = statistics.median(_predicted(e, "variance") for e in effects)
        chosen = " / ".join(dict.fromkeys(map(_choice, effects)))
        cells = [
            scene, result["spp"], chosen, _digits(own), _digits(predicted),
            f"{_digits(others[best])} (`{best}`)",
        ]  # fmt: skip
        print(f"| {' | '.join(map(str, cells))} |")
        pairs = (own, of_all, predicted, of_whole)
        all_pixels.append(f"| {scene} | {' | '.join(map(_digits, pairs))} |")
        of_path.append(own)
        of_best.append(own / max(1, others[best]))
        honest.append(own / predicted)
    print("\n".join(["", *all_pixels, ""]))
    print(
        f"{len(results)} scenes; of path: least {min(of_path):.2f}, geometric mean "
        f"{np.exp(np.mean(np.log(of_path))):.2f}; of the best: least {min(of_best):.2f}, median "
        f"{statistics.median(of_best):.2f}; measured / predicted within 0.7 to 1.4 in "
        f"{sum(0.7 <= ratio <= 1.4 for ratio in honest)}"
    )


def _digits(x: float) -> str:
    """Three digits, without an exponent."""
    return f"{x:.0f}" if x >= 100 else f"{x:.3g}"


@click.command()
@click.argument("files", nargs=-1, type=click.Path(exists=True, path_type=Path))
@click.option("--seconds", default=5.0, show_default=True, help="Of a render with path.")
@click.option("--seeds", default=4, show_default=True)
@click.option("--size", default=(320, 180), type=(int, int), show_default=True)
@click.option("--integrator", "names", multiple=True, default=INTEGRATORS, help="The first: path.")
@click.option("--cpu", is_flag=True, help="Measure the time of all cores.")
@click.option("--references", is_flag=True, help="Measure errors by stored references.")
@click.option("--choices", "chosen", default=0, help="Show what so many seeds choose.")
@click.option("--out", default="out/choices", type=click.Path(path_type=Path), show_default=True)
@click.option("--table", "only_table", is_flag=True, help="Print the table of the results in OUT.")
def main(
    files: tuple[Path, ...],
    seconds: float,
    seeds: int,
    size: tuple[int, int],
    names: tuple[str, ...],
    cpu: bool,
    references: bool,
    chosen: int,
    out: Path,
    only_table: bool,
) -> None:
    """Compares on the scenes FILES."""
    if only_table:
        table(out)
        return
    mi.set_variant("llvm_ad_rgb")
    out.mkdir(parents=True, exist_ok=True)
    for file in files:
        scene = scene_name(file)
        if chosen:
            found = choices(file, seconds, chosen, size).most_common()
            print(f"{scene}: {', '.join(f'{n} x {what}' for what, n in found)}", flush=True)
            continue
        stored_file = _reference_of(file) if references else None
        result = compare(file, seconds, seeds, size, names, cpu, stored_file)
        (out / f"{scene}.json").write_text(json.dumps(result))
        print(line(scene, result), flush=True)
        for name in result["integrators"]:
            kept = [_choice(effects) for effects in result["integrators"][name]["effects"]]
            if set(kept) != {"path"}:
                print(f"    {name} kept, by seed: {' | '.join(kept)}", flush=True)


if __name__ == "__main__":
    main()
