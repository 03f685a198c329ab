"""Comparisons reproduce figures that are known beforehand."""

from __future__ import annotations

import pytest

from mitsuba_ext import compare
from mitsuba_ext.compare import InputError, timing
from mitsuba_ext.compare.experiment import run_seed
from mitsuba_ext.inputs.scenes import scene_name
from tests.support.noisy import WHITE, compare_noisy, noisy_integrator
from tests.support.statistical import some

import mitsuba as mi  # isort: skip

pytestmark = pytest.mark.usefixtures("variant", "without_report")


def is_near(estimate, truth) -> bool:
    """In an interval of twice the width: one in twenty intervals does not hold the truth."""
    low, high = estimate["low"], estimate["high"]
    return low - (high - low) / 2 <= truth <= high + (high - low) / 2


# ---- Known figures ----


def test_error_slope_and_efficiency_of_a_known_noise_are_found(clock, tmp_path):
    integrators = {
        "first": noisy_integrator(clock, sigma=1.0, cost=0.01),
        "better": noisy_integrator(clock, sigma=0.5, cost=0.02),
    }
    scene = compare_noisy(compare.sweep([4, 16, 64]), integrators, tmp_path)
    first, better = scene["integrators"]
    for record, sigma in ((first, 1.0), (better, 0.5)):
        for level in record["levels"]:
            # 2304 values, 3 seeds: standard deviation of their mean square 1.7 %
            expected = sigma**2 / level["level"] / 1.01
            assert level["figures"]["relmse"]["value"] == pytest.approx(expected, rel=0.07)
            assert level["figures"]["mse"]["value"] == pytest.approx(expected * 1.01, rel=0.07)
        for name in ("spp", "seconds"):
            slope = record["slopes"][name]
            assert slope["value"] == pytest.approx(-1, abs=0.05)
            assert is_near(slope, -1)
        last = record["levels"][-1]
        cost = 0.01 if sigma == 1 else 0.02
        efficiency = 1.01 / (sigma**2 * cost)
        assert last["figures"]["efficiency"]["value"] == pytest.approx(efficiency, rel=0.07)
    # A quarter of the variance in twice the time
    ratios = better["levels"][-1]["ratios"]
    assert ratios["efficiency"]["value"] == pytest.approx(2, rel=0.1)
    assert is_near(ratios["efficiency"], 2)
    assert ratios["seconds"]["value"] == pytest.approx(2)
    assert first["levels"][-1]["ratios"]["efficiency"]["value"] == pytest.approx(1)


def test_without_a_reference_the_variance_between_seeds_is_the_error(clock, tmp_path):
    integrators = {
        "first": noisy_integrator(clock, sigma=1.0, cost=0.01),
        "biased": noisy_integrator(clock, sigma=0.5, cost=0.01, mean=0.9),
    }
    comparison = compare.Comparison(
        WHITE, integrators, compare.equal_samples(16), seeds=5, folder=tmp_path,
        with_reference=False,
    )  # fmt: skip
    (scene,) = comparison.run(progress=False)["scenes"]
    first, biased = (one["levels"][0] for one in scene["integrators"])
    assert scene["reference"] is None and not (tmp_path / "references").exists()
    assert first["figures"]["mse"]["value"] == pytest.approx(1 / 16, rel=0.07)
    for name, gain in (("relmse", 0.25), ("relmse_trimmed", 0.25), ("efficiency_trimmed", 4)):
        assert biased["ratios"][name]["value"] == pytest.approx(gain, rel=0.07)
    assert biased["ratios"]["mean"]["value"] == pytest.approx(0.9, rel=0.01)
    assert first["figures"]["flip"] is None


@pytest.mark.parametrize("seeds, budget", [(2, compare.equal_samples(4)), (3, compare.until(0.1))])
def test_what_needs_a_reference_is_refused_without_one(seeds, budget):
    with pytest.raises(InputError, match="without a reference"):
        compare.Comparison(WHITE, ["path"], budget, seeds=seeds, with_reference=False)


def test_cpu_time_is_that_of_the_process(variant, tmp_path, monkeypatch):
    monkeypatch.setattr(timing.time, "process_time", iter(range(0, 1000, 7)).__next__)
    comparison = compare.Comparison(
        WHITE, ["path"], compare.equal_samples(4), folder=tmp_path, with_reference=False,
        cpu_time=True,
    )  # fmt: skip
    results = comparison.run(progress=False)
    (scene,) = results["scenes"]
    assert [run["seconds"] for run in scene["integrators"][0]["runs"]] == [7, 7, 7]
    assert results["clock"] == "cpu"


@pytest.mark.parametrize("budget", [0.3, 1.0, 2.0, 3.5, 5.0, 30.0])
def test_a_time_is_used_although_longer_renders_learn_before(monkeypatch, budget):
    def seconds(spp: int) -> float:
        return 0.04 * spp + (3.0 if spp >= 11 else 0.0)

    def render(integrator, scene, seed, spp, sensor, cpu_time):
        return timing.Timed(seconds(spp), False, 0.0, 1, spp, 0, None)

    monkeypatch.setattr(timing, "timed_render", render)
    spp = timing.samples_for(budget, None, None, 0)
    most = max(n for n in range(1, 1000) if seconds(n) <= budget)
    assert seconds(spp) <= 1.01 * budget
    assert seconds(spp) > 0.5 * seconds(most)


def test_integrators_that_learn_plan_for_the_time_themselves(variant, monkeypatch, tmp_path):
    """No number of samples takes two seconds if a few more make it learn for three."""
    calls = []
    lamp = {"type": "sphere", "center": [0, 0, 5], "emitter": {"type": "area"}}
    for kind in ("auto_path", "auto"):
        render = type(mi.load_dict({"type": kind})).render

        def remembered(self, *arguments, _render=render, **named):
            calls.append((named["timeout"], named["spp"]))
            return _render(self, *arguments, **named)

        monkeypatch.setattr(type(mi.load_dict({"type": kind})), "render", remembered)
    comparison = compare.Comparison(
        {**WHITE, "lamp": lamp}, ["auto_path", "auto"], compare.equal_time(0.1), seeds=1,
        reference_spp=64, folder=tmp_path,
    )  # fmt: skip
    for contender in comparison.run(progress=False)["scenes"][0]["integrators"]:
        assert contender["runs"][0]["spp"] > 0 and not contender["error"]
    assert calls and all(timeout == 0.1 and spp > 1 << 16 for timeout, spp in calls)


@pytest.mark.parametrize(
    "fixed, cost",
    some((3.0, 0.01), (0.0, 1.7), of=[(0.0, 0.01), (3.0, 0.01), (0.0, 1.7), (0.1, 0.0003)]),
)
def test_equal_time_is_used_fully(clock, tmp_path, fixed, cost):
    integrators = {
        "first": noisy_integrator(clock, cost=0.05),
        "other": noisy_integrator(clock, cost=cost, fixed=fixed),
    }
    scene = compare_noisy(compare.equal_time(40), integrators, tmp_path)
    for record in scene["integrators"]:
        for run in record["runs"]:
            assert run["seconds"] == pytest.approx(40, rel=0.05)


def test_until_stops_at_the_error_and_says_what_it_costs(clock, tmp_path):
    integrators = {
        "first": noisy_integrator(clock, cost=0.01),
        "faster": noisy_integrator(clock, cost=0.002, sigma=0.5),
    }
    budget = compare.until(0.01)
    scene = compare_noisy(budget, integrators, tmp_path, reference_spp=4096)
    first, faster = scene["integrators"]
    # σ² / spp / 1.01 ≤ 0.01 after 99 samples and after 25
    assert [level["level"] for level in first["levels"]] == [8, 16, 32, 64, 128]
    assert [level["level"] for level in faster["levels"]] == [8, 16, 32]
    assert first["target"]["spp"]["value"] == pytest.approx(99, rel=0.1)
    assert first["target"]["seconds"]["value"] == pytest.approx(0.99, rel=0.1)
    assert faster["target"]["spp"]["value"] == pytest.approx(24.75, rel=0.15)
    assert is_near(first["target"]["spp"], 99)


@pytest.mark.slow
def test_until_ends_for_a_biased_integrator_that_never_reaches_the_error(clock, tmp_path):
    biased = {"first": noisy_integrator(clock), "biased": noisy_integrator(clock, mean=1.5)}
    scene = compare_noisy(compare.until(0.02), biased, tmp_path, reference_spp=128)
    first, biased = scene["integrators"]
    assert first["target"] and not first["notes"]
    assert biased["target"] is None
    assert biased["levels"][-1]["level"] == 128
    assert "not reached: relMSE 0.2" in biased["notes"][0]


def test_each_level_and_round_has_a_seed_of_its_own_which_integrators_share(clock, tmp_path):
    scene = compare_noisy(
        compare.sweep([16, 4]),
        {"first": noisy_integrator(clock), "second": noisy_integrator(clock, sigma=2.0)},
        tmp_path,
    )
    first, second = ([(run["level"], run["round"], run["seed"]) for run in record["runs"]]
                     for record in scene["integrators"])
    assert first == second
    assert len({seed for _, _, seed in first}) == 6


def test_run_that_had_to_compile_is_thrown_away(clock, tmp_path, monkeypatch):
    timed_render, seen = timing.timed_render, set()

    def compiles_once(integrator, scene, seed, spp, **named):
        timed = timed_render(integrator, scene, seed, spp, **named)
        if (seed, spp) in seen:
            return timed
        seen.add((seed, spp))
        return timed._replace(compiled=True, seconds=timed.seconds + 100)

    monkeypatch.setattr(timing, "timed_render", compiles_once)
    integrators = {"noisy": noisy_integrator(clock, cost=0.01)}
    scene = compare_noisy(compare.equal_samples(64), integrators, tmp_path)
    seconds = [run["seconds"] for run in scene["integrators"][0]["runs"]]
    assert seconds == pytest.approx([0.64] * 3)


def test_integrators_take_turns(clock, tmp_path):
    calls = []
    integrators = {
        name: noisy_integrator(clock, sigma=sigma, calls=calls)
        for name, sigma in (("a", 1.0), ("b", 2.0))
    }
    compare_noisy(compare.equal_samples(64), integrators, tmp_path, seeds=2)
    first, second = run_seed(0, 0), run_seed(0, 1)
    assert [seed for seed, spp in calls if spp == 64] == [first, first, second, second]


def test_costs_of_real_integrators_are_known_as_far_as_they_can_be(tmp_path):
    ball = {"type": "sphere", "to_world": mi.ScalarTransform4f().translate([0, 0, 5]),
            "bsdf": {"type": "diffuse", "reflectance": 0.0}}
    comparison = compare.Comparison(
        {**WHITE, "ball": ball}, ["composed_path", "path", "prb"], compare.equal_samples(16),
        seeds=1, folder=tmp_path, reference_spp=64,
    )
    ours, path, prb = comparison.run()["scenes"][0]["integrators"]
    ours, path, prb = (record["levels"][0]["figures"] for record in (ours, path, prb))
    # The black ball brings nothing back, the sky does
    assert path["zero_radiance"]["value"] == pytest.approx(ours["zero_radiance"]["value"], abs=0.02)
    assert 0.05 < path["zero_radiance"]["value"] < 0.5
    assert prb["zero_radiance"] is None  # no single samples without gradients
    assert ours["rays"]["value"] >= 16 * 32 * 24 and path["rays"] is None
    for figures in (ours, path, prb):
        assert figures["memory"]["value"] > 1000 and figures["launches"]["value"] >= 1
        assert figures["spp"]["value"] == 16 and figures["seconds"]["value"] > 0


# ---- Scenes, films and integrators of all kinds ----


@pytest.mark.parametrize("pixel_format", ["luminance", "luminance_alpha", "rgb", "rgba"])
def test_aovs_and_alpha_are_not_taken_for_colours(tmp_path, pixel_format):
    sensor = {**WHITE["sensor"], "film": {**WHITE["sensor"]["film"], "pixel_format": pixel_format}}
    ball = {"type": "sphere", "to_world": mi.ScalarTransform4f().translate([0, 0, 5])}
    aov = {"type": "aov", "aovs": "d:depth", "image": {"type": "path"}}
    comparison = compare.Comparison(
        {**WHITE, "sensor": sensor, "ball": ball}, {"path": "path", "aov": aov},
        compare.equal_samples(4), seeds=1, folder=tmp_path, reference_spp=64,
    )
    path, aov = comparison.run()["scenes"][0]["integrators"]
    errors = [record["runs"][0]["relmse"] for record in (path, aov)]
    assert errors[1] == pytest.approx(errors[0], rel=1e-3)


@pytest.mark.parametrize(
    "film, message",
    [
        ({"type": "hdrfilm", "pixel_format": "xyz"}, "xyz"),
        ({"type": "specfilm", "band": {"type": "uniform"}}, "no RGB image"),
    ],
)
def test_films_without_rgb_are_refused(film, message):
    variant = "llvm_ad_spectral" if film["type"] == "specfilm" else "llvm_ad_rgb"
    mi.set_variant(variant)
    if film["type"] == "specfilm":
        film = {"type": "specfilm", "band": {"type": "regular", "wavelength_min": 400,
                                             "wavelength_max": 700, "values": "1, 1"}}
    scene = {**WHITE, "sensor": {"type": "perspective", "film": film}}
    with pytest.raises(InputError, match=message):
        compare.Comparison(scene, ["path"], compare.equal_samples(4)).run()
    mi.set_variant("llvm_ad_rgb")


def test_scalar_variants_are_refused():
    mi.set_variant("scalar_rgb")
    with pytest.raises(InputError, match="scalar_rgb"):
        compare.Comparison(WHITE, ["path"], compare.equal_samples(4))
    mi.set_variant("llvm_ad_rgb")


@pytest.mark.parametrize(
    "path, name",
    [("kitchen/scene.xml", "kitchen"), ("/home/me/kitchen/scene.xml", "kitchen"),
     ("scene.xml", "scene"), ("./scene.xml", "scene"), ("../scene.xml", "scene"),
     ("kitchen/night.xml", "night"), ({}, "scene")],
)  # fmt: skip
def test_a_file_called_scene_has_the_name_of_the_folder_that_its_path_names(path, name):
    assert scene_name(path) == name
