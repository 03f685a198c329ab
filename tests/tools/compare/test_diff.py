"""Reading images of any source, and ``mitsuba-ext diff``."""

from __future__ import annotations

import json
import sys

import numpy as np
import pytest

from mitsuba_ext import cli
from mitsuba_ext.compare import InputError, read_exr, read_image, write_exr
from mitsuba_ext.images import metrics

#: Height, width: not square, so that a mix-up of the axes shows.
SHAPE = (4, 6)


def random_image(channel_count: int = 3) -> np.ndarray:
    rng = np.random.default_rng(channel_count)
    return rng.random((*SHAPE, channel_count), dtype=np.float32)


def write_bitmap(path, values: np.ndarray) -> None:
    import mitsuba as mi

    mi.Bitmap(np.ascontiguousarray(values)).write(str(path))


def srgb_to_linear(value: float) -> float:
    return value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4


@pytest.fixture
def run(capsys):
    """Runs ``mitsuba-ext diff`` in this process; returns the exit code, stdout and stderr."""

    def command(*arguments) -> tuple[int, str, str]:
        code = cli.main(["diff", *map(str, arguments)])
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return command


@pytest.fixture
def exr(tmp_path):
    """Writes an EXR: three channels are R/G/B, six are mean and variance."""

    def write(name: str, pixels: np.ndarray):
        color = list("RGB")
        reference = [f"{kind}.{channel}" for kind in ("mean", "variance") for channel in color]
        write_exr(tmp_path / name, pixels, {3: color, 6: reference}[pixels.shape[2]], {})
        return tmp_path / name

    return write


# ---- reading ----


@pytest.mark.parametrize("half", [False, True])
def test_an_exr_is_read_unchanged_with_its_metadata(tmp_path, half):
    path = tmp_path / "image.exr"
    pixels = random_image() - 0.5
    if half:
        pixels = pixels.astype(np.float16)
        write_bitmap(path, pixels)
    else:
        write_exr(path, pixels, "RGB", {"spp": 7})
    read, variance, metadata = read_image(path)
    assert read.dtype == np.float32 and read.shape == (*SHAPE, 3)
    assert np.array_equal(read, pixels) and variance is None
    assert metadata["channels"] == "R/G/B"
    assert half or metadata["spp"] == 7


@pytest.mark.parametrize(
    "names, expected, channels",
    [
        ("A R G B", [1, 2, 3], "R/G/B"),
        ("R G B albedo.R albedo.G albedo.B", [0, 1, 2], "R/G/B"),
        ("Y", [0, 0, 0], "Y"),
        ("A Y", [1, 1, 1], "Y"),
        ("mean.R mean.G mean.B", [0, 1, 2], "mean.R/G/B"),
        ("Combined.R Combined.G Combined.B Depth.Z", [0, 1, 2], "Combined.R/G/B"),
        ("v.a.R v.a.G v.a.B v.a.A v.n.X", [0, 1, 2], "v.a.R/G/B"),
        ("v.Dir.R v.Dir.G v.Dir.B v.Combined.R v.Combined.G v.Combined.B", [3, 4, 5],
         "v.Combined.R/G/B"),
    ],
)
def test_channels_are_found(tmp_path, names, expected, channels):
    path = tmp_path / "image.exr"
    names = names.split()
    pixels = random_image(len(names))
    write_exr(path, pixels, names, {})
    read, variance, metadata = read_image(path)
    assert np.array_equal(read, pixels[:, :, expected]) and variance is None
    assert metadata["channels"] == channels


@pytest.mark.parametrize(
    "names, message",
    [
        ("R G", "needs the channels R/G/B or Y, found R, G"),
        ("Z", "found Z"),
        ("a.R a.G", "found a.R, a.G"),
        ("a.R a.G a.B b.R b.G b.B", "several layers that do: a, b"),
    ],
)
def test_unclear_channels_are_refused(tmp_path, names, message):
    path = tmp_path / "image.exr"
    names = names.split()
    write_exr(path, random_image(len(names)), names, {})
    with pytest.raises(InputError, match=message):
        read_image(path)


def test_first_part_of_several_is_read(tmp_path):
    import OpenEXR

    blue = random_image(1)[:, :, 0]
    colors = {"R": blue * 2, "G": blue * 3, "B": blue}
    depth = {"Z": blue + 1}
    first, last = tmp_path / "first.exr", tmp_path / "last.exr"
    part = OpenEXR.Part
    OpenEXR.File([part({}, colors, "Combined"), part({}, depth, "Depth")]).write(str(first))
    OpenEXR.File([part({}, depth, "Depth"), part({}, colors, "Combined")]).write(str(last))
    assert np.array_equal(read_image(first)[0][:, :, 2], blue)
    with pytest.raises(InputError, match="found Z .only the first part"):
        read_image(last)


def test_reference_brings_its_variance(exr):
    pixels = random_image(6)
    read, variance, metadata = read_image(exr("reference.exr", pixels))
    assert np.array_equal(read, pixels[:, :, :3])
    assert np.array_equal(variance, pixels[:, :, 3:])
    assert metadata["channels"] == "mean.R/G/B"


@pytest.mark.parametrize("dtype, white", [(np.uint8, 255), (np.uint16, 65535)])
def test_png_is_made_linear(tmp_path, dtype, white):
    path = tmp_path / "image.png"
    values = (random_image() * white).astype(dtype)
    values[0, 0] = 0, white // 50, white  # 0.02: the linear part of the curve
    write_bitmap(path, values)
    read, variance, _ = read_image(path)
    expected = np.vectorize(srgb_to_linear)(values / white)
    assert np.allclose(read, expected, rtol=1e-6, atol=0) and variance is None
    assert read[0, 0, 2] == 1


def test_png_of_grey_and_alpha(tmp_path):
    path = tmp_path / "image.png"
    values = (random_image(4) * 255).astype(np.uint8)
    write_bitmap(path, values)
    with_alpha = read_image(path)[0]
    write_bitmap(path, values[:, :, :3])
    assert np.array_equal(with_alpha, read_image(path)[0])
    write_bitmap(path, values[:, :, :1])
    grey = read_image(path)[0]
    assert np.array_equal(grey, np.repeat(with_alpha[:, :, :1], 3, axis=2))


def test_jpeg_is_nearly_the_png(tmp_path):
    values = np.full((8, 16, 3), (200, 100, 50), np.uint8)
    for name in ("a.png", "a.jpg"):
        write_bitmap(tmp_path / name, values)
    png, jpeg = (read_image(tmp_path / name)[0] for name in ("a.png", "a.jpg"))
    assert np.allclose(png, jpeg, rtol=0.05)


@pytest.mark.parametrize("extension, tolerance", [("pfm", 0), ("hdr", 0.02)])
def test_hdr_and_pfm_are_linear(tmp_path, extension, tolerance):
    path = tmp_path / f"image.{extension}"
    pixels = random_image() + 0.5
    write_bitmap(path, pixels)
    assert np.allclose(read_image(path)[0], pixels, rtol=tolerance, atol=0)


def test_content_decides_not_the_extension(tmp_path, exr):
    pixels = random_image()
    path = exr("image.exr", pixels).rename(tmp_path / "image.png")
    assert np.array_equal(read_image(path)[0], pixels)


@pytest.mark.parametrize("shape", [SHAPE, (*SHAPE, 1), (*SHAPE, 3), (*SHAPE, 4)])
@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_arrays_are_linear(tmp_path, shape, dtype):
    array = np.random.default_rng(0).random(shape).astype(dtype)
    np.save(tmp_path / "image.npy", array)
    np.savez_compressed(tmp_path / "image.npz", beauty=array)
    rgb = array[..., :3] if len(shape) == 3 and shape[2] > 1 else array.reshape(*SHAPE, 1)
    expected = np.broadcast_to(rgb.astype(np.float32), (*SHAPE, 3))
    for name, channels in (("image.npy", "array"), ("image.npz", "beauty")):
        read, variance, metadata = read_image(tmp_path / name)
        assert read.dtype == np.float32 and np.array_equal(read, expected)
        assert variance is None and metadata == {"channels": channels}


def test_npz_of_mean_and_variance(tmp_path):
    mean, variance = random_image(), random_image(4)[:, :, :3]
    np.savez(tmp_path / "a.npz", variance=variance, mean=mean, spp=7)
    read = read_image(tmp_path / "a.npz")
    assert np.array_equal(read[0], mean) and np.array_equal(read[1], variance)


# ---- the command ----


def test_diff_reports_the_metrics(run, exr):
    image, reference = random_image(), random_image(4)[:, :, :3]
    code, out, err = run("--json", exr("a.exr", image), exr("b.exr", reference))
    assert (code, err) == (0, "")
    record = json.loads(out)
    expected = metrics.errors(image, reference)
    for name in ("relmse", "relmse_trimmed", "mse", "rmse", "sigma_mu", "flip"):
        assert record[name] == getattr(expected, name), name
    assert record["size"] == [6, 4] and record["identical"] is False
    assert record["image"].endswith("a.exr") and record["reference"].endswith("b.exr")
    assert record["mean"]["image"] == pytest.approx(image.mean(axis=(0, 1)))
    ratio = image.mean(axis=(0, 1)) / reference.mean(axis=(0, 1))
    assert record["mean"]["ratio"] == pytest.approx(ratio, rel=1e-6)
    assert record["reference_noise"] is None and record["z"] is None


def test_diff_locates_the_largest_difference(run, exr):
    reference = np.ones((*SHAPE, 3))
    image = reference.copy()
    image[1, 2, 0] = 1.25
    image[3, 5, 1] = 0.5
    a, b = exr("a.exr", image), exr("b.exr", reference)
    record = json.loads(run("--json", a, b)[1])
    assert record["largest_difference"] == {"value": -0.5, "x": 5, "y": 3, "channel": "G"}
    assert record["differing_pixels"] == 2
    _, out, _ = run(a, b)
    assert "2 of 24 pixels differ, most at x=5, y=3: G is 0.5000 instead of 1.000" in out
    for heading in ("relMSE", "trimmed", "MSE", "rMSE", "σ/μ", "FLIP", "ratio A / B"):
        assert heading in out


def test_order_of_the_images_matters(run, exr):
    a, b = exr("a.exr", np.full((*SHAPE, 3), 3.0)), exr("b.exr", np.full((*SHAPE, 3), 2.0))
    assert json.loads(run("--json", a, b)[1])["relmse"] == pytest.approx(1 / 4.04)
    assert json.loads(run("--json", b, a)[1])["relmse"] == pytest.approx(1 / 9.09)


@pytest.mark.parametrize("value", [0, 0.5])
def test_identical_images_are_called_so(run, exr, value):
    # With variances: they must not make a negative error of it
    pixels = np.full((*SHAPE, 6), value)
    a, b = exr("a.exr", pixels), exr("b.exr", pixels)
    code, out, _ = run(a, b)
    assert code == 0 and "identical (6x4)" in out and "relMSE" not in out
    record = json.loads(run("--json", a, b)[1])
    assert record["identical"] is True
    assert record["relmse"] == record["mse"] == record["flip"] == record["differing_pixels"] == 0


def test_variance_of_the_reference_is_subtracted_and_gives_z(run, exr):
    reference = np.concatenate([np.full((*SHAPE, 3), 2.0), np.full((*SHAPE, 3), 0.25)], axis=2)
    image = np.concatenate([np.full((*SHAPE, 3), 3.0), np.full((*SHAPE, 3), 0.75)], axis=2)
    image[:, :, 5] = 0
    reference[:, :, 5] = 0
    a, b = exr("a.exr", image), exr("b.exr", reference)
    record = json.loads(run("--json", a, b)[1])
    assert record["mse"] == pytest.approx(1 - 0.5 / 3)
    assert record["reference_noise"] == pytest.approx(0.5 / 3 / 4.04)
    # (3 − 2) / √((0.25 + 0.75) / 24 pixels)
    assert record["z"] == [pytest.approx(24**0.5), pytest.approx(24**0.5), None]
    _, out, _ = run(a, b)
    assert "z of A − B" in out and "(mean.R/G/B)" in out and "subtracted" in out
    without = json.loads(run("--json", exr("c.exr", image[:, :, :3]), b)[1])
    assert without["z"] is None and without["reference_noise"] is not None


def test_z_of_two_unbiased_images_is_small(run, exr):
    rng = np.random.default_rng(5)
    paths = []
    for name, variance in (("a.exr", 0.04), ("b.exr", 0.01)):
        mean = 1 + variance**0.5 * rng.standard_normal((64, 64, 3))
        paths.append(exr(name, np.concatenate([mean, np.full_like(mean, variance)], axis=2)))
    assert max(map(abs, json.loads(run("--json", *paths)[1])["z"])) < 4


def test_unknown_numbers_are_null_in_json_and_dashes_in_the_table(run, exr, monkeypatch):
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    reference = np.ones((*SHAPE, 3))
    reference[:, :, 2] = 0
    a, b = exr("a.exr", reference + 1), exr("b.exr", reference)
    record = json.loads(run("--json", a, b)[1])
    assert record["flip"] is None and record["mean"]["ratio"] == [2, 2, None]
    _, out, _ = run(a, b)
    assert "–" in out and "flip-evaluator" in out


def test_files_of_different_kinds_are_compared_as_linear_rgb(run, tmp_path):
    values = (random_image() * 255).astype(np.uint8)
    write_bitmap(tmp_path / "a.png", values)
    linear = np.vectorize(srgb_to_linear)(values / 255)
    np.save(tmp_path / "b.npy", linear)
    record = json.loads(run("--json", tmp_path / "a.png", tmp_path / "b.npy")[1])
    assert record["rmse"] < 1e-7


def test_signed_difference_is_written(run, exr, tmp_path):
    image, reference = random_image(), random_image(4)[:, :, :3]
    output = tmp_path / "diff.exr"
    a, b = exr("a.exr", image), exr("b.exr", reference)
    code, out, _ = run(a, b, "-o", output)
    assert code == 0 and str(output) in out
    channels, metadata = read_exr(output)
    assert np.array_equal(np.stack([channels[name] for name in "RGB"], axis=2), image - reference)
    assert (metadata["image"], metadata["reference"]) == (str(a), str(b))


# ---- bad input ----


@pytest.fixture
def files(exr, tmp_path):
    """Everything that can be wrong with a file, and ``good.exr``."""
    good = random_image()
    exr("good.exr", good)
    exr("black.exr", good * 0)
    exr("wide.exr", np.ones((4, 9, 3)))
    bad = good.copy()
    bad[2, 3, 1] = np.nan
    bad[3, 1, 0] = np.inf
    exr("nan.exr", bad)
    exr("nan_variance.exr", np.concatenate([good, bad], axis=2))
    (tmp_path / "text.exr").write_text("hello, this is not an image\n")
    (tmp_path / "empty.png").write_bytes(b"")
    write_bitmap(tmp_path / "cut.png", (good * 255).astype(np.uint8))
    for name, source in (("cut.png", "cut.png"), ("cut.exr", "good.exr")):
        content = (tmp_path / source).read_bytes()
        (tmp_path / name).write_bytes(content[: len(content) * 2 // 3])
    np.save(tmp_path / "uint8.npy", (good * 255).astype(np.uint8))
    np.save(tmp_path / "object.npy", np.array([{}, []], dtype=object))
    np.save(tmp_path / "vector.npy", np.ones(5))
    np.save(tmp_path / "two.npy", np.ones((4, 6, 2)))
    np.save(tmp_path / "none.npy", np.ones((0, 6, 3)))
    np.save(tmp_path / "huge.npy", np.full((4, 6), 1e300))
    np.savez(tmp_path / "several.npz", a=good, b=good)
    np.savez(tmp_path / "unfit.npz", mean=good, variance=good[:2])
    (tmp_path / "text.npy").write_text("hello")
    content = (tmp_path / "several.npz").read_bytes()
    (tmp_path / "cut.npz").write_bytes(content[:-100])
    return tmp_path


@pytest.mark.parametrize(
    "arguments, message",
    [
        ([], "Missing argument 'A'"),
        (["good.exr"], "Missing argument 'B'"),
        (["missing.exr", "good.exr"], "missing.exr: no such file"),
        (["good.exr", "missing.npy"], "missing.npy: no such file"),
        ([".", "good.exr"], "is not a file"),
        (["text.exr", "good.exr"], "text.exr: unreadable"),
        (["empty.png", "good.exr"], "empty.png: unreadable"),
        (["cut.png", "good.exr"], "cut.png: unreadable"),
        (["cut.exr", "good.exr"], "cut.exr: unreadable"),
        (["text.npy", "good.exr"], "text.npy: unreadable"),
        (["cut.npz", "good.exr"], "cut.npz: unreadable"),
        (["object.npy", "good.exr"], "object.npy: unreadable"),
        (["uint8.npy", "good.exr"], "uint8.npy: holds uint8 values"),
        (["vector.npy", "good.exr"], "vector.npy: an array 5 is not an image"),
        (["two.npy", "good.exr"], "two.npy: an array 4x6x2 is not an image"),
        (["none.npy", "good.exr"], "none.npy: an array 0x6x3 is not an image"),
        (["several.npz", "good.exr"], "several.npz: needs one array, or mean and variance"),
        (["unfit.npz", "good.exr"], "unfit.npz: mean and variance do not fit"),
        (["huge.npy", "good.exr"], "huge.npy: 24 of 24 pixels not finite"),
        (["nan.exr", "good.exr"], "nan.exr: 2 of 24 pixels not finite (first at x=3, y=2)"),
        (["good.exr", "nan.exr"], "nan.exr: 2 of 24 pixels not finite (first at x=3, y=2)"),
        (["good.exr", "nan_variance.exr"], "nan_variance.exr: variance: 2 of 24 pixels"),
        (["good.exr", "wide.exr"], "good.exr: is 6x4, but"),
        (["good.exr", "black.exr"], "black.exr: the reference is black"),
        (["good.exr", "good.exr", "-o", "diff.png"], "diff.png: the difference is written as .exr"),
        (["good.exr", "good.exr", "-o", "none/diff.exr"], "none: no such folder"),
    ],
    ids=lambda value: str(value)[-40:],
)
def test_bad_input_is_one_line_and_exit_code_2(run, files, monkeypatch, arguments, message):
    monkeypatch.chdir(files)
    before = sorted(files.iterdir())
    code, out, err = run(*arguments)
    assert code == 2 and out == ""
    assert message in err
    assert err.count("\n") == 1 and err.startswith("mitsuba-ext: ")
    assert sorted(files.iterdir()) == before


def test_damaged_file_is_one_line_from_the_process(files, monkeypatch, capfd):
    monkeypatch.chdir(files)
    for name in ("cut.png", "cut.exr", "cut.npz"):
        assert cli.main(["diff", name, "good.exr"]) == 2
        captured = capfd.readouterr()  # also what libraries write past Python
        assert captured.out == "" and captured.err.count("\n") == 1
