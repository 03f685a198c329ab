"""Signatures of the functions of this package, made from the pages of the plugins by
``make stubs``. The documentation of a parameter explains a default of ``...``."""

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import mitsuba as mi

class _Described(Protocol):
    """A plugin of mitsuba-scene-description."""
    def to_dict(self) -> dict[str, Any]: ...

class _Transformed(Protocol):
    """A transform of mitsuba-scene-description."""
    def to_mi(self) -> Any: ...

Plugin = Mapping[str, Any] | mi.Object | _Described
Texture = Plugin
Spectrum = float | Plugin
Transform = mi.ScalarTransform4f | _Transformed
Vector = Sequence[float]


def adaptive(
    *,
    threshold: float = 0,
    pass_spp: int = 0,
    count_samples: bool = False,
    timeout: float = -1,
    checkpoint: str = "",
    checkpoint_every: str = "60s",
    nested: Plugin = ...,
    id: str = ...,
) -> dict[str, Any]:
    """Adaptive sampling (adaptive).

    Renders with a nested integrator, and takes more samples in pixels with a large error. The image
    is unbiased.

    Parameters:
        threshold (float): Relative error of a pixel (one standard error) at which it needs no more
            samples; 0 spends all samples. (Default: 0)
        pass_spp (int): Samples per pixel of the first pass, and of each later pass on average; 0
            for an eighth of all samples. (Default: 0)
        count_samples (bool): Whether to add a channel samples to the image, with the number of
            samples of each pixel. (Default: false)
        timeout (float): Seconds after which to stop, learning and compilation included; 0 or less
            for no limit. (Default: -1)
        checkpoint (string): A folder in which the render is saved: a second render (of the same
            scene, seed and parameters) continues from there, up to spp, which may be higher than
            before. (Default: none)
        checkpoint_every (string): How often it is saved: 60s, 10m, 2h or 100spp. (Default: 60s)
        (Nested plugin) (integrator): The integrator to render with, exactly one: any that samples
            camera rays, such as path, volpath or an integrator of this package.
    """


def auto(
    *,
    pilot_spp: int = ...,
    save_learned: str = "",
    load_learned: str = "",
    keep_learned: bool = False,
    max_depth: int = -1,
    rr_depth: int = 5,
    hide_emitters: bool = False,
    timeout: float = -1,
    checkpoint: str = "",
    checkpoint_every: str = "60s",
    aovs: str = "",
    id: str = ...,
) -> dict[str, Any]:
    """Self-configuring integrator (auto).

    Begins as path, and measures which techniques are worth their time in this scene: guided
    directions or focal points, learned lights, and maps of times, lens points, wavelengths and
    distances (auto_path); light paths, their number, the number of connections to them, and merging
    with them (vcm; in participating media, also sppm).

    Parameters:
        pilot_spp (int): Number of pilot samples per pixel, from which the integrator learns; at
            most an eighth of all samples up to 262144 pilot samples, a sixteenth beyond, and a
            quarter in short renders. (Default: 32; 0 in renders of fewer than 262144 samples)
        save_learned, load_learned (string): Names of files. (Default: none)
        keep_learned (bool): Whether to keep what is learned for later renders of this process
            (frames, notebooks). (Default: false)
        max_depth (int): Longest path in the image, -1 for no limit. (Default: -1)
        rr_depth (int): Path depth at which Russian roulette on the throughput begins. (Default: 5)
        hide_emitters (bool): Hide directly visible emitters. (Default: false)
        timeout (float): Seconds after which to stop, learning and compilation included; 0 or less
            for no limit. (Default: -1)
        checkpoint (string): A folder in which the render is saved: a second render (of the same
            scene, seed and parameters) continues from there, up to spp, which may be higher than
            before. (Default: none)
        checkpoint_every (string): How often it is saved: 60s, 10m, 2h or 100spp. (Default: 60s)
        aovs (string): Arbitrary output variables, in the syntax of Mitsuba's aov integrator, such
            as depth:depth,nn:sh_normal. (Default: none)
    """


def auto_path(
    *,
    pilot_spp: int = ...,
    save_learned: str = "",
    load_learned: str = "",
    keep_learned: bool = False,
    clamp_direct: float = 0,
    clamp_indirect: float = 0,
    caustics: str = "scattered",
    max_depth: int = -1,
    rr_depth: int = 5,
    hide_emitters: bool = False,
    timeout: float = -1,
    checkpoint: str = "",
    checkpoint_every: str = "60s",
    aovs: str = "",
    id: str = ...,
) -> dict[str, Any]:
    """Self-configuring path tracer (auto_path).

    A path tracer that chooses its techniques itself: guided directions or focal points, learned
    lights, and maps of the times, lens points, wavelengths and distances in fog with which paths
    find light. Its first samples test which of them reduce the noise of this scene by more than
    they cost, and it keeps those.

    Parameters:
        pilot_spp (int): Number of pilot samples per pixel, from which the integrator learns; at
            most an eighth of all samples up to 262144 pilot samples, a sixteenth beyond, and a
            quarter in short renders. (Default: 32; 0 in renders of fewer than 262144 samples)
        save_learned, load_learned (string): Names of files. (Default: none)
        keep_learned (bool): Whether to keep what is learned for later renders of this process
            (frames, notebooks). (Default: false)
        clamp_direct, clamp_indirect (float): Biased: the largest light of a sample, see
            composed_path. (Default: 0)
        caustics (string): Whether paths also connect to lights through smooth glass and mirrors, as
            in composed_path: never (scattered), always (manifold, or bounded_manifold, which is
            biased), or where pilots find that it pays (automatic, which may choose wrongly).
            (Default: scattered)
        max_depth (int): Longest path in the image, -1 for no limit. (Default: -1)
        rr_depth (int): Path depth at which Russian roulette on the throughput begins. (Default: 5)
        hide_emitters (bool): Hide directly visible emitters. (Default: false)
        timeout (float): Seconds after which to stop, learning and compilation included; 0 or less
            for no limit. (Default: -1)
        checkpoint (string): A folder in which the render is saved: a second render (of the same
            scene, seed and parameters) continues from there, up to spp, which may be higher than
            before. (Default: none)
        checkpoint_every (string): How often it is saved: 60s, 10m, 2h or 100spp. (Default: 60s)
        aovs (string): Arbitrary output variables, in the syntax of Mitsuba's aov integrator, such
            as depth:depth,nn:sh_normal. (Default: none)
    """


def bdpt(
    *,
    connections: int = 1,
    light_image: bool = True,
    subpath_selection: str = "uniform",
    light_paths: float | str = "always",
    sample_direct: bool = True,
    technique_images: str = "",
    next_event: str | Plugin = ...,
    directions: str | Plugin = ...,
    roulette: str | Plugin = ...,
    shadow_test: str | Plugin = ...,
    max_depth: int = -1,
    rr_depth: int = 5,
    hide_emitters: bool = False,
    timeout: float = -1,
    checkpoint: str = "",
    checkpoint_every: str = "60s",
    aovs: str = "",
    id: str = ...,
) -> dict[str, Any]:
    """Bidirectional path tracer (bdpt).

    For each sample, traces a path from the camera and a path from a light, connects their vertices,
    and weights all contributions by multiple importance sampling.

    Parameters:
        connections (int): How many vertices of light paths, chosen at random, each vertex of a
            camera path is connected to; 0 for none. (Default: 1)
        light_image (bool): Whether to connect light paths to the sensor as well (t = 1). (Default:
            true)
        subpath_selection (string): How the vertices of light paths are chosen: uniform, or by
            visibility, which prefers regions whose vertices were visible from the camera path's
            vertex, and contributed light, in the pilot samples. (Default: uniform)
        light_paths (float or string): Number of light paths per camera path, from 0 (camera paths
            alone) to 64; or always, which is 1; or auto: pilot samples measure whether 0, 1/16,
            1/4, 1 or 4 light paths are most efficient in a render of this length, together with
            connections, two or four times as many connections, or none. (Default: always)
        sample_direct (bool): Whether to connect camera paths to points sampled on lights (s = 1).
            (Default: true)
        technique_images (string): Name of an OpenEXR file to which the image of each technique is
            written, with and without its MIS weights (layers weighted.s1_t2 and plain.s1_t2, with s
            vertices on the light path and t on the camera path), for paths of up to 8 segments.
            (Default: none)
        next_event, directions, roulette, shadow_test (string or decision): Decisions of the camera
            paths, as in composed_path. (Default: as in path)
        max_depth (int): Longest path in the image, -1 for no limit. (Default: -1)
        rr_depth (int): Path depth at which Russian roulette on the throughput begins. (Default: 5)
        hide_emitters (bool): Hide directly visible emitters. (Default: false)
        timeout (float): Seconds after which to stop, learning and compilation included; 0 or less
            for no limit. (Default: -1)
        checkpoint (string): A folder in which the render is saved: a second render (of the same
            scene, seed and parameters) continues from there, up to spp, which may be higher than
            before. (Default: none)
        checkpoint_every (string): How often it is saved: 60s, 10m, 2h or 100spp. (Default: 60s)
        aovs (string): Arbitrary output variables, in the syntax of Mitsuba's aov integrator, such
            as depth:depth,nn:sh_normal. (Default: none)
    """


def composed_path(
    *,
    directions: str | Plugin = "uniform",
    scattering: str | Plugin = "bsdf",
    next_event: str | Plugin = "uniform",
    light_numbers: str = "uniform",
    roulette: str = "automatic",
    flights: str = "automatic",
    connections: str | int | Plugin = "one",
    mis: str | Plugin = "power",
    shadow_test: str | Plugin = "always",
    caustics: str = "scattered",
    aperture: str | Plugin = "sampler",
    time: str | Plugin = "sampler",
    wavelength: str | Plugin = "sampler",
    distance: str = "sampler",
    pilot_spp: int = ...,
    save_learned: str = "",
    load_learned: str = "",
    keep_learned: bool = False,
    clamp_direct: float = 0,
    clamp_indirect: float = 0,
    max_depth: int = -1,
    rr_depth: int = 5,
    hide_emitters: bool = False,
    timeout: float = -1,
    checkpoint: str = "",
    checkpoint_every: str = "60s",
    aovs: str = "",
    id: str = ...,
) -> dict[str, Any]:
    """Composed path tracer (composed_path).

    A path tracer whose sampling decisions are chosen in the scene file. Each of its slots holds one
    decision: a word, or a nested plugin with parameters of its own. With all defaults it is
    Mitsuba's path, except that it traces no shadow ray for connections that cannot contribute. It
    uses the same random numbers and gives the same image, as long as one pass of two million
    samples is enough. When Mitsuba 3.9.1 merges rectangles of one material, it computes wrong
    bounds for the scene; sky and sun then leak through walls in path, but not here.

    Parameters:
        directions (string or decision): Which random numbers choose the next direction of a path:
            uniform numbers, guided numbers, or a nested guided_directions. (Default: uniform)
        scattering (string or decision): What samples the next direction of a path: the bsdf; with
            focal or a nested focal_points, also learned places through which light passes, such as
            keyholes and slits; with swarm, also learned maps, at the first vertex that is not a
            mirror (see swarm_path). (Default: bsdf)
        next_event (string or decision): Which light a vertex is connected to, and which point of
            it. (Default: uniform)
        light_numbers (string): Which random numbers choose the light and the point on it, at the
            first vertex that is connected to lights: uniform numbers, or with swarm, numbers from
            learned maps (see swarm_path). (Default: uniform)
        roulette (string): Which paths Russian roulette continues, from rr_depth on. throughput is
            the rule of path. (Default: automatic)
        flights (string): How far paths fly in homogeneous media before they scatter. transmittance
            is the choice of volpath. (Default: automatic)
        connections (string, int or decision): How many points on lights the first vertex of a path
            is connected to: one, a number (of points from a hammersley set), or a nested
            weighted_connections. (Default: one)
        mis (string or decision): How connections to lights, and BSDF samples that hit lights, are
            weighted: power, balance, cutoff, maximum, bsdf or light alone, or a nested
            mis_heuristic. (Default: power)
        shadow_test (string or decision): Whether the shadow ray of a connection is traced: always,
            by visibility_roulette (learned), or by a nested visibility_roulette with parameters.
            (Default: always)
        caustics (string): How paths find light that smooth glass, water or mirrors lead to a
            vertex. (Default: scattered)
        aperture, time, wavelength (string or decision): Which random numbers choose the point on
            the aperture, the time, and the wavelengths of a camera ray. (Default: sampler)
        distance (string): Which random numbers choose the distance that a camera ray travels in a
            homogeneous medium. (Default: sampler)
        pilot_spp (int): Number of pilot samples per pixel, from which decisions learn; at most an
            eighth of all samples (a quarter in short renders; half, if only swarm learns).
            (Default: 64 with swarm, 32 with guided directions or focal points, 4 if only
            triple_product learns, otherwise 16)
        save_learned, load_learned (string): Names of files. (Default: none)
        keep_learned (bool): Whether to keep what is learned for later renders of this process
            (frames, notebooks). (Default: false)
        clamp_direct, clamp_indirect (float): Biased. (Default: 0)
        max_depth (int): Longest path in the image, -1 for no limit. (Default: -1)
        rr_depth (int): Path depth at which Russian roulette on the throughput begins. (Default: 5)
        hide_emitters (bool): Hide directly visible emitters. (Default: false)
        timeout (float): Seconds after which to stop, learning and compilation included; 0 or less
            for no limit. (Default: -1)
        checkpoint (string): A folder in which the render is saved: a second render (of the same
            scene, seed and parameters) continues from there, up to spp, which may be higher than
            before. (Default: none)
        checkpoint_every (string): How often it is saved: 60s, 10m, 2h or 100spp. (Default: 60s)
        aovs (string): Arbitrary output variables, in the syntax of Mitsuba's aov integrator, such
            as depth:depth,nn:sh_normal. (Default: none)
    """


def composed_prb(
    *,
    directions: str | Plugin = "uniform",
    next_event: str | Plugin = "uniform",
    roulette: str = "automatic",
    flights: str = "automatic",
    connections: str | int | Plugin = "one",
    mis: str | Plugin = "power",
    shadow_test: str | Plugin = "always",
    pilot_spp: int = ...,
    save_learned: str = "",
    load_learned: str = "",
    learn_every: int = 128,
    gradient_samples: str = "even",
    max_depth: int = -1,
    rr_depth: int = 5,
    hide_emitters: bool = False,
    timeout: float = ...,
    id: str = ...,
) -> dict[str, Any]:
    """Gradients of the composed path tracer (composed_prb).

    Path replay backpropagation, as in Mitsuba's prb and prbvolpath, along the paths of
    composed_path. Lights and directions can be learned, which makes gradients less noisy in scenes
    with many or hidden lights. For use with mi.render(scene, params, integrator=…).

    Parameters:
        directions (string or decision): As in composed_path, except swarm. (Default: uniform)
        next_event (string or decision): As in composed_path, except resampled, two_stage and
            triple_product. (Default: uniform)
        roulette (string): As in composed_path. (Default: automatic)
        flights (string): As in composed_path. (Default: automatic)
        connections (string, int or decision): As in composed_path. (Default: one)
        mis (string or decision): As in composed_path. (Default: power)
        shadow_test (string or decision): As in composed_path. (Default: always)
        pilot_spp (int): As in composed_path, but at most a fifth of the samples of the renders that
            use what is learned. (Default: 32 with guided directions, otherwise 16)
        save_learned, load_learned (string): As in composed_path. (Default: none)
        learn_every (int): Number of renders of a scene after which the next one learns again,
            because materials and lights may have changed; 0 to learn only once. (Default: 128)
        gradient_samples (string): Samples of the passes for gradients: even, the same number in
            each pixel, or loss, more in pixels where the derivative of the loss is large: the loss
            depends on them, and they depend on what is optimized. (Default: even)
        max_depth (int): Longest path in the image, -1 for no limit. (Default: -1)
        rr_depth (int): Path depth at which Russian roulette on the throughput begins, counted as in
            prb: one vertex later than in composed_path. (Default: 5)
        hide_emitters (bool): Hide directly visible emitters. (Default: false)
        timeout (float): Seconds after which a render of the image (not of gradients) ends, learning
            included. (Default: -1, none)
    """


def control_variate(
    *,
    max_sensors: int = 64,
    nested: Plugin = ...,
    max_depth: int | bool = ...,
    rr_depth: int | bool = ...,
    hide_emitters: int | bool = ...,
    id: str = ...,
) -> dict[str, Any]:
    """Recursive control variates (control_variate).

    Makes the images of an optimization less noisy, and with them its gradients: the image of the
    last step is corrected by the difference of two renders, before and after the parameters
    changed, which have the same random numbers and hence almost the same noise. For use with
    mi.render(scene, params, integrator=…), around an integrator that computes gradients.

    Parameters:
        max_sensors (int): Most sensors whose last images are kept. (Default: 64)
        (Nested plugin) (integrator): The integrator to render with, at most one: composed_prb, prb,
            prbvolpath, direct_projective, or another one that computes gradients. (Default:
            composed_prb with next_event = contribution and gradient_samples = loss)
        max_depth, rr_depth, hide_emitters (int, int, bool): Parameters of the default integrator,
            accepted only without a nested one. (Default: as in composed_prb)
    """


def ecoc_dof(
    *,
    aperture_radius: float = 0,
    focus_distance: float = 0,
    filter: str = "lens",
    hidden_spp: int = 0,
    denoise: bool = False,
    timeout: float = -1,
    checkpoint: str = "",
    checkpoint_every: str = "60s",
    nested: Plugin = ...,
    id: str = ...,
) -> dict[str, Any]:
    """Effective circle of confusion (ecoc_dof).

    Renders with a nested integrator from the centre of the lens, and computes depth of field from
    that image with a filter. This biased approximation needs a fraction of the samples. A near,
    blurred object hides a part of the lens from the objects behind its edge, which makes these
    objects sharper and shifts them; the filter reproduces this.

    Parameters:
        aperture_radius, focus_distance (float): Aperture radius and focus distance of the lens, in
            units of the scene; with 0, the sensor's own, if the sensor is a thinlens. (Default: 0)
        filter (string): lens computes, for each of several points of the lens, which layer hides
            which. effective is the filter of the source: a separable filter for near surfaces, and
            a smaller and shifted circle of confusion for all others. (Default: lens)
        hidden_spp (int): Samples per pixel for surfaces that are hidden, or outside the film, but
            seen by a part of the lens; 0 for half of the image's samples per pixel. (Default: 0)
        denoise (bool): Whether to denoise the layers before they are filtered (with Open Image
            Denoise, from the package mitsuba-oidn), except for pixels that show a light. (Default:
            false)
        timeout (float): Seconds after which to stop, learning and compilation included; 0 or less
            for no limit. (Default: -1)
        checkpoint (string): A folder in which the render is saved: a second render (of the same
            scene, seed and parameters) continues from there, up to spp, which may be higher than
            before. (Default: none)
        checkpoint_every (string): How often it is saved: 60s, 10m, 2h or 100spp. (Default: 60s)
        (Nested plugin) (integrator): The integrator to render with, exactly one: any that samples
            camera rays, such as path, volpath or an integrator of this package.
    """


def erpt(
    *,
    mutations: str = "primary",
    bidirectional: bool = False,
    outliers: float = ...,
    mutations_per_pixel: int = 0,
    chain_length: int = 100,
    luminance_samples: int = 100000,
    proposal_filter: int = 0,
    most_consecutive: int = 0,
    bidirectional_mutation: bool = False,
    lens_perturbation: bool = True,
    multi_chain_perturbation: bool = True,
    caustic_perturbation: bool = True,
    next_event: str | Plugin = ...,
    direct_samples: int = 0,
    chain_file: str = "",
    max_depth: int = -1,
    rr_depth: int = 5,
    hide_emitters: bool = False,
    timeout: float = -1,
    checkpoint: str = "",
    checkpoint_every: str = "60s",
    aovs: str = "",
    id: str = ...,
) -> dict[str, Any]:
    """Energy redistribution path tracing (erpt).

    Takes independent samples, and distributes the excess energy of the outliers among them by short
    Markov chains.

    Parameters:
        mutations (string): What the chains mutate: primary, the random numbers of a sample, or
            path, the vertices of a light path (mlt). (Default: primary)
        bidirectional (bool): Whether chains sample the paths of bdpt; if not, they sample the paths
            of path. (Default: false)
        outliers (float): A sample is an outlier if it is more than this many times as bright as its
            part of the image. (Default: 10; with paths 0)
        mutations_per_pixel (int): Number of mutations per pixel if all energy is redistributed.
            (Default: 0)
        chain_length (int): Number of mutations of each chain. (Default: 100)
        luminance_samples (int): Minimum number of independent samples that first measure the
            brightness of the image and of its parts. (Default: 100000)
        proposal_filter (int): Makes the noise of the chains' light more even, but is biased: each
            pixel is multiplied by the expected number of mutations that are proposed there, and
            divided by their actual number. (Default: 0)
        most_consecutive (int): Removes specks, but is biased towards black: of the consecutive
            visits of a chain to a pixel, only this many are added to the image. (Default: 0)
        bidirectional_mutation (bool): With mutations=path: whether to replace a part of the path by
            a random walk from both sides. (Default: false)
        lens_perturbation, multi_chain_perturbation, caustic_perturbation (bool): With
            mutations=path: as in mlt. (Default: true)
        next_event (string or decision): How points on lights are chosen, as in composed_path.
            (Default: as in path)
        direct_samples (int): Camera samples per pixel for visible lights and direct light, which
            path finds well; the chains find the rest. (Default: 0)
        chain_file (string): A file. (Default: none)
        max_depth (int): Longest path in the image, -1 for no limit. (Default: -1)
        rr_depth (int): Path depth at which Russian roulette on the throughput begins. (Default: 5)
        hide_emitters (bool): Hide directly visible emitters. (Default: false)
        timeout (float): Seconds after which to stop, learning and compilation included; 0 or less
            for no limit. (Default: -1)
        checkpoint (string): A folder in which the render is saved: a second render (of the same
            scene, seed and parameters) continues from there, up to spp, which may be higher than
            before. (Default: none)
        checkpoint_every (string): How often it is saved: 60s, 10m, 2h or 100spp. (Default: 60s)
        aovs (string): Arbitrary output variables, in the syntax of Mitsuba's aov integrator, such
            as depth:depth,nn:sh_normal. (Default: none)
    """


def instant_radiosity(
    *,
    light_paths: int = 300,
    interleaving: int = 1,
    connections: int = 1,
    choice: str = "power",
    bound: float = 5,
    compensation: bool = True,
    light_aovs: bool = False,
    pilot_spp: int | str | bool = 16,
    save_learned: int | str | bool = "",
    load_learned: int | str | bool = "",
    keep_learned: int | str | bool = "false",
    next_event: str | Plugin = ...,
    shadow_test: str | Plugin = ...,
    max_depth: int = -1,
    rr_depth: int = 5,
    hide_emitters: bool = False,
    timeout: float = -1,
    checkpoint: str = "",
    checkpoint_every: str = "60s",
    aovs: str = "",
    id: str = ...,
) -> dict[str, Any]:
    """Instant radiosity (instant_radiosity).

    The vertices of a few light paths become virtual point lights, which all pixels share. Camera
    paths are connected to them at the first surface that is not a mirror, where most of them end.
    Connections are bounded, and BSDF sampling finds the light that the bound cuts off. The image
    therefore converges to the image of path.

    Parameters:
        light_paths (int): Number of light paths that form a set of virtual lights. (Default: 300)
        interleaving (int): Neighbouring pixels use different sets, in a pattern that repeats after
            this many pixels in both directions; with 1, all pixels share one set. (Default: 1)
        connections (int): How many virtual lights a vertex is connected to. (Default: 1)
        choice (string): How virtual lights are chosen: uniform; power (by the flux that they emit);
            clustered (by flux, distance and cosines, with a light tree); or learned (by flux, and
            by how much light, occlusion included, pilot samples found to arrive at a place from
            each region: for long renders). (Default: power)
        bound (float): The largest geometry term of a connection, in units of 1 / (diagonal of the
            scene)². (Default: 5)
        compensation (bool): Whether BSDF sampling finds the light that the bound cuts off.
            (Default: true)
        light_aovs (bool): Whether to write the parts that add up to the image to the channels
            direct.R, virtual.R, compensation.R, …, and a picture of the virtual lights to lights.R,
            …: see below. (Default: false)
        pilot_spp, save_learned, load_learned, keep_learned (int, string or bool): As in
            composed_path; accepted only if choice is learned. (Default: 16, none, none, false)
        next_event, shadow_test (string or decision): How lights are chosen for direct light; see
            composed_path.
        max_depth (int): Longest path in the image, -1 for no limit. (Default: -1)
        rr_depth (int): Path depth at which Russian roulette on the throughput begins. (Default: 5)
        hide_emitters (bool): Hide directly visible emitters. (Default: false)
        timeout (float): Seconds after which to stop, learning and compilation included; 0 or less
            for no limit. (Default: -1)
        checkpoint (string): A folder in which the render is saved: a second render (of the same
            scene, seed and parameters) continues from there, up to spp, which may be higher than
            before. (Default: none)
        checkpoint_every (string): How often it is saved: 60s, 10m, 2h or 100spp. (Default: 60s)
        aovs (string): Arbitrary output variables, in the syntax of Mitsuba's aov integrator, such
            as depth:depth,nn:sh_normal. (Default: none)
    """


def irradiance_cache(
    *,
    accuracy: float = 0.4,
    min_spacing: float = 2,
    max_spacing: float = 60,
    gather_samples: int = 512,
    effort: float = 0.5,
    max_share: float = 0.1,
    cache_file: str = "",
    next_event: str | Plugin = ...,
    shadow_test: str | Plugin = ...,
    max_depth: int = -1,
    rr_depth: int = 5,
    hide_emitters: bool = False,
    timeout: float = -1,
    checkpoint: str = "",
    checkpoint_every: str = "60s",
    aovs: str = "",
    id: str = ...,
) -> dict[str, Any]:
    """Irradiance cache (irradiance_cache).

    Computes the irradiance of indirect light and its gradients at a few places on diffuse surfaces,
    from many paths each, and interpolates between these places. Direct light, and everything that
    is not diffuse, is sampled as in path.

    Parameters:
        accuracy (float): a of Eq. (Default: 0.4)
        min_spacing (float): The smallest radius in which a record is valid, in pixel widths at its
            place. (Default: 2)
        max_spacing (float): The largest radius in which a record is valid, in the same units.
            (Default: 60)
        gather_samples (int): Approximate number of paths from each record. (Default: 512)
        effort (float): Maximum number of paths from all records, divided by the number of samples
            of the image. (Default: 0.5)
        max_share (float): The largest share of a record's irradiance that one path may contribute;
            any excess is cut off. (Default: 0.1)
        cache_file (string): Name of a file that keeps the records. (Default: none)
        next_event, shadow_test (string or decision): How lights are chosen; see composed_path.
        max_depth (int): Longest path in the image, -1 for no limit. (Default: -1)
        rr_depth (int): Path depth at which Russian roulette on the throughput begins. (Default: 5)
        hide_emitters (bool): Hide directly visible emitters. (Default: false)
        timeout (float): Seconds after which to stop, learning and compilation included; 0 or less
            for no limit. (Default: -1)
        checkpoint (string): A folder in which the render is saved: a second render (of the same
            scene, seed and parameters) continues from there, up to spp, which may be higher than
            before. (Default: none)
        checkpoint_every (string): How often it is saved: 60s, 10m, 2h or 100spp. (Default: 60s)
        aovs (string): Arbitrary output variables, in the syntax of Mitsuba's aov integrator, such
            as depth:depth,nn:sh_normal. (Default: none)
    """


def light_tracer(
    *,
    lens_sampling: str = "uniform",
    max_depth: int = -1,
    rr_depth: int = 5,
    hide_emitters: bool = False,
    timeout: float = -1,
    checkpoint: str = "",
    checkpoint_every: str = "60s",
    aovs: str = "",
    id: str = ...,
) -> dict[str, Any]:
    """Light tracer (light_tracer).

    Traces paths from the lights and connects each of their vertices to the sensor. It renders the
    same image as path, except for what it cannot see (below), and finds caustics that path hardly
    ever finds.

    Parameters:
        lens_sampling (string): How a connection to a thinlens chooses the point on the aperture:
            uniform, or by visibility, in the parts of the lens that nothing occludes. (Default:
            uniform)
        max_depth (int): Longest path in the image, -1 for no limit. (Default: -1)
        rr_depth (int): Path depth at which Russian roulette on the throughput begins. (Default: 5)
        hide_emitters (bool): Hide directly visible emitters. (Default: false)
        timeout (float): Seconds after which to stop, learning and compilation included; 0 or less
            for no limit. (Default: -1)
        checkpoint (string): A folder in which the render is saved: a second render (of the same
            scene, seed and parameters) continues from there, up to spp, which may be higher than
            before. (Default: none)
        checkpoint_every (string): How often it is saved: 60s, 10m, 2h or 100spp. (Default: 60s)
        aovs (string): Arbitrary output variables, in the syntax of Mitsuba's aov integrator, such
            as depth:depth,nn:sh_normal. (Default: none)
    """


def mlt(
    *,
    p_large: float = 0.2,
    bidirectional_mutation: bool = True,
    lens_perturbation: bool = True,
    multi_chain_perturbation: bool = True,
    caustic_perturbation: bool = True,
    luminance_samples: int = 100000,
    chains: int = 0,
    two_stage: bool = False,
    direct_samples: int = 0,
    chain_file: str = "",
    max_depth: int = -1,
    rr_depth: int = 5,
    hide_emitters: bool = False,
    timeout: float = -1,
    checkpoint: str = "",
    checkpoint_every: str = "60s",
    aovs: str = "",
    id: str = ...,
) -> dict[str, Any]:
    """Path space Metropolis light transport (mlt).

    Markov chains mutate light paths vertex by vertex, and stay longer at paths that carry much
    light.

    Parameters:
        p_large (float): The probability of a new, independent path. (Default: 0.2)
        bidirectional_mutation (bool): Whether to replace a part of the path by a random walk from
            both sides. (Default: true)
        lens_perturbation (bool): Whether to perturb the position on the film, and the path up to
            its first two consecutive vertices that are neither mirrors nor smooth glass. (Default:
            true)
        multi_chain_perturbation (bool): Whether to do the same for paths that other surfaces
            scatter in between. (Default: true)
        caustic_perturbation (bool): Whether to perturb the direction in which light leaves its
            source, or the last diffuse surface before the one that the camera sees. (Default: true)
        luminance_samples (int): Minimum number of independent paths that estimate the brightness of
            the image, and from which chains start. (Default: 100000)
        chains (int): Number of chains, which run in parallel; at most the number of mutations.
            (Default: 0)
        two_stage (bool): Whether to first estimate the brightness of the parts of the image, and
            then spread mutations evenly over these parts instead of in proportion to their
            brightness. (Default: false)
        direct_samples (int): Camera samples per pixel for visible lights and direct light, which
            path finds well; the chains find the rest. (Default: 0)
        chain_file (string): A file. (Default: none)
        max_depth (int): Longest path in the image, -1 for no limit. (Default: -1)
        rr_depth (int): Path depth at which Russian roulette on the throughput begins. (Default: 5)
        hide_emitters (bool): Hide directly visible emitters. (Default: false)
        timeout (float): Seconds after which to stop, learning and compilation included; 0 or less
            for no limit. (Default: -1)
        checkpoint (string): A folder in which the render is saved: a second render (of the same
            scene, seed and parameters) continues from there, up to spp, which may be higher than
            before. (Default: none)
        checkpoint_every (string): How often it is saved: 60s, 10m, 2h or 100spp. (Default: 60s)
        aovs (string): Arbitrary output variables, in the syntax of Mitsuba's aov integrator, such
            as depth:depth,nn:sh_normal. (Default: none)
    """


def neepp(
    *,
    light_sampling: str = "contribution",
    rejection: bool = False,
    grid: int = ...,
    max_memory: float = 512,
    pilot_spp: int = 16,
    save_learned: str = "",
    load_learned: str = "",
    keep_learned: bool = False,
    law: Any = ...,
    slope: Any = 10,
    floor: Any = 0.1,
    refine: int = 16,
    clamp_direct: float = 0,
    clamp_indirect: float = 0,
    caustics: str = "scattered",
    max_depth: int = -1,
    rr_depth: int = 5,
    hide_emitters: bool = False,
    timeout: float = -1,
    checkpoint: str = "",
    checkpoint_every: str = "60s",
    aovs: str = "",
    id: str = ...,
) -> dict[str, Any]:
    """Next event estimation++ (neepp).

    A path tracer that learns from its first samples which lights reach which surfaces. It samples
    lights accordingly, including parts of large lights and directions of the sky, and can reject
    most of the shadow rays that would be blocked. Both techniques are unbiased. The integrator is
    composed_path with learned_lights, and on request with visibility_roulette; the pages of these
    plugins have the details.

    Parameters:
        light_sampling (string): How a light is chosen at each vertex, as with next_event of
            composed_path. (Default: contribution)
        rejection (bool): Whether to reject shadow rays by learned visibility. (Default: false)
        grid (int): Number of voxels along each axis of the region in which paths scatter (of the
            scene's bounding box, if light_sampling is not learned). (Default: as for
            learned_lights, spatial_lights or visibility_roulette)
        max_memory (float): Memory for what is learned, and for the table of spatial, in MiB.
            (Default: 512)
        pilot_spp (int): Number of pilot samples per pixel, from which the integrator learns; at
            most an eighth of all samples (a quarter in short renders). (Default: 16)
        save_learned, load_learned (string): Names of files. (Default: none)
        keep_learned (bool): Whether to keep what is learned for later renders of this process
            (frames, notebooks). (Default: false)
        law, slope, floor (several): With rejection: the law of visibility_roulette. (Default:
            affine, 10, 0.1)
        refine (int): With rejection, and only if light sampling is not learned: the number of
            random visibility tests of visibility_roulette. (Default: 16)
        clamp_direct, clamp_indirect (float): Biased: the largest light of a sample, see
            composed_path. (Default: 0)
        caustics (string): Whether paths also connect to lights through smooth glass and mirrors
            (manifold, or bounded_manifold, which is biased), as in composed_path. (Default:
            scattered)
        max_depth (int): Longest path in the image, -1 for no limit. (Default: -1)
        rr_depth (int): Path depth at which Russian roulette on the throughput begins. (Default: 5)
        hide_emitters (bool): Hide directly visible emitters. (Default: false)
        timeout (float): Seconds after which to stop, learning and compilation included; 0 or less
            for no limit. (Default: -1)
        checkpoint (string): A folder in which the render is saved: a second render (of the same
            scene, seed and parameters) continues from there, up to spp, which may be higher than
            before. (Default: none)
        checkpoint_every (string): How often it is saved: 60s, 10m, 2h or 100spp. (Default: 60s)
        aovs (string): Arbitrary output variables, in the syntax of Mitsuba's aov integrator, such
            as depth:depth,nn:sh_normal. (Default: none)
    """


def photon_map(
    *,
    photons: int = 250000,
    final_gather: bool = True,
    guided: bool = False,
    lookup_size: int = 30,
    global_radius: float = ...,
    caustic_radius: float = ...,
    photon_aovs: bool = False,
    next_event: str | Plugin = ...,
    shadow_test: str | Plugin = ...,
    max_depth: int = -1,
    rr_depth: int = 5,
    hide_emitters: bool = False,
    timeout: float = -1,
    checkpoint: str = "",
    checkpoint_every: str = "60s",
    aovs: str = "",
    id: str = ...,
) -> dict[str, Any]:
    """Photon mapping (photon_map).

    Traces photons once, before the render. Camera paths then end early: the light that leaves the
    second diffuse surface of a path, and the caustics that fall on the first, are estimated from
    nearby photons. Direct light is sampled as in path.

    Parameters:
        photons (int): Number of light paths. (Default: 250000)
        final_gather (bool): Whether one more segment from the first diffuse surface finds indirect
            light. (Default: true)
        guided (bool): Whether half of the segments of the final gather follow the directions from
            which photons have come. (Default: false)
        lookup_size (int): Number of photons that an estimate should use; it determines the radii
            that are 0. (Default: 30)
        global_radius, caustic_radius (float): Radius within which photons of the two maps are
            looked up, in units of the scene. (Default: 0: the most suitable of four radii, by the
            photons around the place)
        photon_aovs (bool): Whether to write the estimates of the two maps alone, for the surface
            that a pixel shows, to the channels global.R, caustic.R, … (Default: false)
        next_event, shadow_test (string or decision): How lights are chosen for direct light; see
            composed_path.
        max_depth (int): Longest path in the image, -1 for no limit. (Default: -1)
        rr_depth (int): Path depth at which Russian roulette on the throughput begins. (Default: 5)
        hide_emitters (bool): Hide directly visible emitters. (Default: false)
        timeout (float): Seconds after which to stop, learning and compilation included; 0 or less
            for no limit. (Default: -1)
        checkpoint (string): A folder in which the render is saved: a second render (of the same
            scene, seed and parameters) continues from there, up to spp, which may be higher than
            before. (Default: none)
        checkpoint_every (string): How often it is saved: 60s, 10m, 2h or 100spp. (Default: 60s)
        aovs (string): Arbitrary output variables, in the syntax of Mitsuba's aov integrator, such
            as depth:depth,nn:sh_normal. (Default: none)
    """


def pss_guided(
    *,
    regions: str = "surfaces",
    tile: int = 16,
    bounces: int = ...,
    nee_first_bounce: bool = True,
    pilot_spp: int = 32,
    save_learned: str = "",
    load_learned: str = "",
    keep_learned: bool = False,
    always_guide: bool = False,
    max_memory: float = 512,
    clamp_direct: float = 0,
    clamp_indirect: float = 0,
    caustics: str = "scattered",
    max_depth: int = -1,
    rr_depth: int = 5,
    hide_emitters: bool = False,
    timeout: float = -1,
    checkpoint: str = "",
    checkpoint_every: str = "60s",
    aovs: str = "",
    id: str = ...,
) -> dict[str, Any]:
    """Path guiding in primary sample space (pss_guided).

    A path tracer that learns from its first samples which random numbers lead the BSDF to sample
    directions from which light comes, and draws these numbers more often. It is unbiased, needs no
    knowledge of materials and lights, and guides all BSDFs in the same way. It is composed_path
    with guided_directions, whose page says how it learns.

    Parameters:
        regions (string): What a tree of samples belongs to: a region of surfaces, or one of the
            tiles of the film, as in the thesis. (Default: surfaces)
        tile (int): Edge of a tile in pixels; accepted only with tiles. (Default: 16)
        bounces (int): Maximum number of directions of a path that are guided. (Default: 6; 2 with
            tiles)
        nee_first_bounce (bool): Whether to connect the first vertex of a path to lights. (Default:
            true)
        pilot_spp (int): Number of pilot samples per pixel, from which the integrator learns; at
            most an eighth of all samples (a quarter in short renders). (Default: 32)
        save_learned, load_learned (string): Names of files. (Default: none)
        keep_learned (bool): Whether to keep what is learned for later renders of this process
            (frames, notebooks). (Default: false)
        always_guide (bool): Whether to guide all bounces, even if the pilots show that guiding does
            not pay. (Default: false)
        max_memory (float): Memory for what is recorded and learned, in MiB. (Default: 512)
        clamp_direct, clamp_indirect (float): Biased: the largest light of a sample, see
            composed_path. (Default: 0)
        caustics (string): Whether paths also connect to lights through smooth glass and mirrors
            (manifold, or bounded_manifold, which is biased), as in composed_path. (Default:
            scattered)
        max_depth (int): Longest path in the image, -1 for no limit. (Default: -1)
        rr_depth (int): Path depth at which Russian roulette on the throughput begins. (Default: 5)
        hide_emitters (bool): Hide directly visible emitters. (Default: false)
        timeout (float): Seconds after which to stop, learning and compilation included; 0 or less
            for no limit. (Default: -1)
        checkpoint (string): A folder in which the render is saved: a second render (of the same
            scene, seed and parameters) continues from there, up to spp, which may be higher than
            before. (Default: none)
        checkpoint_every (string): How often it is saved: 60s, 10m, 2h or 100spp. (Default: 60s)
        aovs (string): Arbitrary output variables, in the syntax of Mitsuba's aov integrator, such
            as depth:depth,nn:sh_normal. (Default: none)
    """


def pssmlt(
    *,
    bidirectional: bool = True,
    p_large: float = 0.3,
    luminance_samples: int = 100000,
    kelemen_style_weights: bool = True,
    chains: int = 0,
    two_stage: bool = False,
    next_event: str | Plugin = ...,
    direct_samples: int = 0,
    chain_file: str = "",
    max_depth: int = -1,
    rr_depth: int = 5,
    hide_emitters: bool = False,
    timeout: float = -1,
    checkpoint: str = "",
    checkpoint_every: str = "60s",
    aovs: str = "",
    id: str = ...,
) -> dict[str, Any]:
    """Primary sample space Metropolis light transport (pssmlt).

    Markov chains mutate the random numbers of a bidirectional path tracer (or of path), and stay
    longer at numbers that find much light.

    Parameters:
        bidirectional (bool): Whether chains sample the paths of bdpt; if not, they sample the paths
            of path. (Default: true)
        p_large (float): The probability of a large step, which draws all random numbers anew.
            (Default: 0.3)
        luminance_samples (int): Minimum number of independent samples that estimate the brightness
            of the image, and from which chains start. (Default: 100000)
        kelemen_style_weights (bool): Whether large steps also serve as independent samples,
            weighted by the balance heuristic. (Default: true)
        chains (int): Number of chains, which run in parallel; at most the number of mutations.
            (Default: 0)
        two_stage (bool): Whether to first estimate the brightness of the parts of the image, and
            then spread mutations evenly over these parts instead of in proportion to their
            brightness. (Default: false)
        next_event (string or decision): How points on lights are chosen, as in composed_path.
            (Default: as in path)
        direct_samples (int): Camera samples per pixel for visible lights and direct light, which
            path finds well; the chains find the rest. (Default: 0)
        chain_file (string): A file. (Default: none)
        max_depth (int): Longest path in the image, -1 for no limit. (Default: -1)
        rr_depth (int): Path depth at which Russian roulette on the throughput begins. (Default: 5)
        hide_emitters (bool): Hide directly visible emitters. (Default: false)
        timeout (float): Seconds after which to stop, learning and compilation included; 0 or less
            for no limit. (Default: -1)
        checkpoint (string): A folder in which the render is saved: a second render (of the same
            scene, seed and parameters) continues from there, up to spp, which may be higher than
            before. (Default: none)
        checkpoint_every (string): How often it is saved: 60s, 10m, 2h or 100spp. (Default: 60s)
        aovs (string): Arbitrary output variables, in the syntax of Mitsuba's aov integrator, such
            as depth:depth,nn:sh_normal. (Default: none)
    """


def reweighted_direct(
    *,
    light_samples: int = 256,
    vertices: str = "first",
    pattern: str = "hammersley",
    weights: str = "",
    camera_samples: int = 0,
    clamp_direct: float = 0,
    clamp_indirect: float = 0,
    max_depth: int = -1,
    rr_depth: int = 5,
    hide_emitters: bool = False,
    timeout: float = -1,
    checkpoint: str = "",
    checkpoint_every: str = "60s",
    aovs: str = "",
    id: str = ...,
) -> dict[str, Any]:
    """Reweighted light samples (reweighted_direct).

    A path tracer that connects the first vertex of each path to many points on lights. The points
    come from well distributed point sets, and each connection can be weighted by the Voronoi cell
    of its point. Later vertices of a path are connected to one point each, as in path. It is
    composed_path with weighted_connections, whose page has the details.

    Parameters:
        light_samples (int): Number of points in a set, which is the number of connections of the
            first vertex; at most 4096 (1024 with poisson_disk), because beyond that, more camera
            samples are a better use of the time. (Default: 256)
        vertices (string): Which vertices have this many connections: the first, or all. (Default:
            first)
        pattern (string): How the points of a set are distributed: independent, stratified,
            latin_hypercube, halton, hammersley, sobol, lattice or poisson_disk. (Default:
            hammersley)
        weights (string): Weights of the points: none, torus, unbiased or voronoi (slightly biased).
            (Default: none)
        camera_samples (int): Samples per pixel of a render without spp; 0 for the number of the
            sensor's sampler, which is 4 by default. (Default: 0)
        clamp_direct, clamp_indirect (float): Biased: the largest light of a sample, see
            composed_path. (Default: 0)
        max_depth (int): Longest path in the image, -1 for no limit. (Default: -1)
        rr_depth (int): Path depth at which Russian roulette on the throughput begins. (Default: 5)
        hide_emitters (bool): Hide directly visible emitters. (Default: false)
        timeout (float): Seconds after which to stop, learning and compilation included; 0 or less
            for no limit. (Default: -1)
        checkpoint (string): A folder in which the render is saved: a second render (of the same
            scene, seed and parameters) continues from there, up to spp, which may be higher than
            before. (Default: none)
        checkpoint_every (string): How often it is saved: 60s, 10m, 2h or 100spp. (Default: 60s)
        aovs (string): Arbitrary output variables, in the syntax of Mitsuba's aov integrator, such
            as depth:depth,nn:sh_normal. (Default: none)
    """


def reweighted_lens(
    *,
    pattern: str = "lattice",
    weights: str = "",
    timeout: float = -1,
    checkpoint: str = "",
    checkpoint_every: str = "60s",
    nested: Plugin = ...,
    id: str = ...,
) -> dict[str, Any]:
    """Reweighted lens samples (reweighted_lens).

    Renders depth of field with the nested integrator, but takes the points on the aperture from the
    well distributed point sets of weighted_numbers, where each sample can be weighted by the
    Voronoi cell of its point. Each pixel uses one set for all of its samples.

    Parameters:
        pattern (string): How the points of a set are distributed, see weighted_numbers:
            independent, stratified, latin_hypercube, halton, hammersley, sobol, lattice or
            poisson_disk. (Default: lattice)
        weights (string): Weights of the points, see weighted_numbers: none, torus, unbiased or
            voronoi (slightly biased). (Default: none)
        timeout (float): Seconds after which to stop, 0 or less for no limit; see composed_path.
            (Default: -1)
        checkpoint (string): A folder in which the render is saved; see composed_path. (Default:
            none)
        checkpoint_every (string): How often it is saved, such as 60s or 100spp. (Default: 60s)
        (Nested plugin) (integrator): The integrator to render with, exactly one: any that samples
            camera rays, such as path, volpath or one of ours without chains.
    """


def reweighted_time(
    *,
    pattern: str = "lattice",
    weights: str = "",
    timeout: float = -1,
    checkpoint: str = "",
    checkpoint_every: str = "60s",
    nested: Plugin = ...,
    id: str = ...,
) -> dict[str, Any]:
    """Reweighted times (reweighted_time).

    Renders motion blur with the nested integrator, but takes the times in the shutter interval from
    the well distributed point sets of weighted_numbers, where each sample can be weighted by the
    Voronoi cell of its time. Each pixel uses one set for all of its samples.

    Parameters:
        pattern (string): How the points of a set are distributed, see weighted_numbers:
            independent, stratified, latin_hypercube, halton, hammersley, sobol, lattice or
            poisson_disk. (Default: lattice)
        weights (string): Weights of the points, see weighted_numbers: none, torus, unbiased or
            voronoi (slightly biased). (Default: none)
        timeout (float): Seconds after which to stop, 0 or less for no limit; see composed_path.
            (Default: -1)
        checkpoint (string): A folder in which the render is saved; see composed_path. (Default:
            none)
        checkpoint_every (string): How often it is saved, such as 60s or 100spp. (Default: 60s)
        (Nested plugin) (integrator): The integrator to render with, exactly one: any that samples
            camera rays, such as composed_path.
    """


def reweighted_wavelength(
    *,
    weights: str = "",
    pattern: str = "lattice",
    timeout: float = -1,
    checkpoint: str = "",
    checkpoint_every: str = "60s",
    nested: Plugin = ...,
    id: str = ...,
) -> dict[str, Any]:
    """Reweighted wavelengths (reweighted_wavelength).

    Renders in spectral variants with the nested integrator, but takes the random numbers that
    choose the wavelengths from the well distributed point sets of weighted_numbers, where each
    sample can be weighted by the Voronoi cell of its number. Each pixel uses one set for all of its
    samples.

    Parameters:
        weights (string): Weights of the points, see weighted_numbers: none, torus or voronoi
            (slightly biased). (Default: none)
        pattern (string): How the points of a set are distributed, see weighted_numbers:
            independent, stratified, latin_hypercube, halton, hammersley, sobol, lattice or
            poisson_disk. (Default: lattice)
        timeout (float): Seconds after which to stop, 0 or less for no limit; see composed_path.
            (Default: -1)
        checkpoint (string): A folder in which the render is saved; see composed_path. (Default:
            none)
        checkpoint_every (string): How often it is saved, such as 60s or 100spp. (Default: 60s)
        (Nested plugin) (integrator): The integrator to render with, exactly one: any that samples
            camera rays, such as path, volpath or one of this package.
    """


def sppm(
    *,
    radius: float = 0,
    radius_in_media: float = 0,
    radius_decay: float = 0.75,
    light_paths: float = 1,
    max_depth: int = -1,
    rr_depth: int = 5,
    hide_emitters: bool = False,
    timeout: float = -1,
    checkpoint: str = "",
    checkpoint_every: str = "60s",
    aovs: str = "",
    id: str = ...,
) -> dict[str, Any]:
    """Stochastic progressive photon mapping (sppm).

    Traces photons from the lights in each pass. From nearby photons, it estimates the light that
    leaves the first rough surface of each camera path, and the light that participating media
    scatter on the way there. The radius shrinks from pass to pass, so the image converges.

    Parameters:
        radius (float): Radius within which photons are looked up in a first pass of one sample per
            pixel, in units of the scene. (Default: 0)
        radius_in_media (float): As radius, for photons in participating media, which are looked up
            in a ball: a pass of k samples per pixel uses 1/k of the volume. (Default: 0)
        radius_decay (float): α, in (0, 1]: the squared radius of pass i (in media, its cube) is the
            squared radius (or cube) of the first pass times i to the power of α − 1. (Default:
            0.75)
        light_paths (float): Number of light paths per camera path. (Default: 1)
        max_depth (int): Longest path in the image, -1 for no limit. (Default: -1)
        rr_depth (int): Path depth at which Russian roulette on the throughput begins. (Default: 5)
        hide_emitters (bool): Hide directly visible emitters. (Default: false)
        timeout (float): Seconds after which to stop, learning and compilation included; 0 or less
            for no limit. (Default: -1)
        checkpoint (string): A folder in which the render is saved: a second render (of the same
            scene, seed and parameters) continues from there, up to spp, which may be higher than
            before. (Default: none)
        checkpoint_every (string): How often it is saved: 60s, 10m, 2h or 100spp. (Default: 60s)
        aovs (string): Arbitrary output variables, in the syntax of Mitsuba's aov integrator, such
            as depth:depth,nn:sh_normal. (Default: none)
    """


def swarm_path(
    *,
    time_map: bool = True,
    lens_map: bool = True,
    wavelength_map: bool = True,
    distance_map: bool = True,
    light_map: bool = True,
    lobe_map: bool = True,
    direction_map: bool = False,
    always_use: bool = False,
    pilot_spp: int = 64,
    save_learned: str = "",
    load_learned: str = "",
    keep_learned: bool = False,
    clamp_direct: float = 0,
    clamp_indirect: float = 0,
    caustics: str = "scattered",
    max_depth: int = -1,
    rr_depth: int = 5,
    hide_emitters: bool = False,
    timeout: float = -1,
    checkpoint: str = "",
    checkpoint_every: str = "60s",
    aovs: str = "",
    id: str = ...,
) -> dict[str, Any]:
    """Sample swarming (swarm_path).

    A path tracer in which neighbouring pixels tell each other which random numbers found light. For
    each kind of sampling decision, every tile of the film has a map: a table of probabilities over
    the random numbers of this decision, learned from the samples of the image itself. It is
    unbiased, and uses only maps that reduce the variance by enough to be worth their time. It is
    composed_path with the word swarm in several slots.

    Parameters:
        time_map (bool): Whether to learn at which times of the shutter interval paths find light.
            (Default: true)
        lens_map (bool): Whether to learn through which parts of the aperture paths find light.
            (Default: true)
        wavelength_map (bool): Whether to learn at which wavelengths paths find light. (Default:
            true)
        distance_map (bool): Whether to learn at which distances in a homogeneous medium camera rays
            find light. (Default: true)
        light_map (bool): Whether to learn which light, and which point on it, to sample for the
            first connection of a path. (Default: true)
        lobe_map (bool): Whether to learn the choice between reflection and transmission at the
            first eight bounces. (Default: true)
        direction_map (bool): Whether to learn from which directions light arrives at the first
            vertex that is not a mirror. (Default: false)
        always_use (bool): Whether to use all maps, even if the pilots show that they do not pay.
            (Default: false)
        pilot_spp (int): Number of pilot samples per pixel, from which the integrator learns; at
            most half of all samples (a quarter, if there are fewer than 8). (Default: 64)
        save_learned, load_learned (string): Names of files. (Default: none)
        keep_learned (bool): Whether to keep what is learned for later renders of this process
            (frames, notebooks). (Default: false)
        clamp_direct, clamp_indirect (float): Biased: the largest light of a sample, see
            composed_path. (Default: 0)
        caustics (string): Whether paths also connect to lights through smooth glass and mirrors
            (manifold, or bounded_manifold, which is biased), as in composed_path. (Default:
            scattered)
        max_depth (int): Longest path in the image, -1 for no limit. (Default: -1)
        rr_depth (int): Path depth at which Russian roulette on the throughput begins. (Default: 5)
        hide_emitters (bool): Hide directly visible emitters. (Default: false)
        timeout (float): Seconds after which to stop, learning and compilation included; 0 or less
            for no limit. (Default: -1)
        checkpoint (string): A folder in which the render is saved: a second render (of the same
            scene, seed and parameters) continues from there, up to spp, which may be higher than
            before. (Default: none)
        checkpoint_every (string): How often it is saved: 60s, 10m, 2h or 100spp. (Default: 60s)
        aovs (string): Arbitrary output variables, in the syntax of Mitsuba's aov integrator, such
            as depth:depth,nn:sh_normal. (Default: none)
    """


def two_stage(
    *,
    light_samples: int = 16,
    splits: int = 16,
    vertices: str = "first",
    visibility: str = "unknown",
    reallocated: float = 0.9,
    pilot_spp: int = 4,
    save_learned: str = "",
    load_learned: str = "",
    keep_learned: bool = False,
    clamp_direct: float = 0,
    clamp_indirect: float = 0,
    caustics: str = "scattered",
    max_depth: int = -1,
    rr_depth: int = 5,
    hide_emitters: bool = False,
    timeout: float = -1,
    checkpoint: str = "",
    checkpoint_every: str = "60s",
    aovs: str = "",
    id: str = ...,
) -> dict[str, Any]:
    """Two-stage importance sampling (two_stage).

    A path tracer that connects the first vertex of each path to several directions of the
    environment. It samples them in proportion to an estimate of the product of environment map and
    BSDF. It is composed_path with two_stage_lights, whose page has the details, and
    weighted_connections.

    Parameters:
        light_samples (int): Number of connections of the first vertex, at most 1024. (Default: 16)
        splits (int): Maximum number of times that a vertex divides rectangles of the map, in
            addition to the first division into eight rectangles. (Default: 16)
        vertices (string): Which vertices divide the map and have this many connections: the first,
            or all. (Default: first)
        visibility (string): How connections of first vertices take occlusion into account: not at
            all (unknown), or by visibility maps that a pilot has learned, over random numbers
            (primary) or over directions (world). (Default: unknown)
        reallocated (float): With visibility maps: the share of the connections that the maps
            sample, 0 to 0.99. (Default: 0.9)
        pilot_spp (int): With visibility maps: number of pilot samples per pixel, at most an eighth
            of all samples (a quarter in short renders). (Default: 4)
        save_learned, load_learned (string): With visibility maps: as in composed_path. (Default:
            none)
        keep_learned (bool): With visibility maps: as in composed_path. (Default: false)
        clamp_direct, clamp_indirect (float): Biased: the largest light of a sample, see
            composed_path. (Default: 0)
        caustics (string): Whether paths also connect to lights through smooth glass and mirrors
            (manifold, or bounded_manifold, which is biased), as in composed_path. (Default:
            scattered)
        max_depth (int): Longest path in the image, -1 for no limit. (Default: -1)
        rr_depth (int): Path depth at which Russian roulette on the throughput begins. (Default: 5)
        hide_emitters (bool): Hide directly visible emitters. (Default: false)
        timeout (float): Seconds after which to stop, learning and compilation included; 0 or less
            for no limit. (Default: -1)
        checkpoint (string): A folder in which the render is saved: a second render (of the same
            scene, seed and parameters) continues from there, up to spp, which may be higher than
            before. (Default: none)
        checkpoint_every (string): How often it is saved: 60s, 10m, 2h or 100spp. (Default: 60s)
        aovs (string): Arbitrary output variables, in the syntax of Mitsuba's aov integrator, such
            as depth:depth,nn:sh_normal. (Default: none)
    """


def variance(
    *,
    batches: int = 16,
    nested: Plugin = ...,
    id: str = ...,
) -> dict[str, Any]:
    """Variance from batches (variance).

    Renders the nested integrator in independent batches, each with a seed of its own. The image is
    the mean of the batches, and the channels variance.R, variance.G and variance.B estimate the
    variance of this mean, which is the squared standard error of each pixel.

    Parameters:
        batches (int): Number of batches, 2 to 65536. (Default: 16)
        (Nested plugin) (integrator): The integrator to render with, exactly one.
    """


def vcm(
    *,
    merging: str = "caustics",
    radius: float = 0,
    radius_in_media: float = 0,
    radius_decay: float = 0.75,
    connections: int = 1,
    light_image: bool = True,
    subpath_selection: str = "uniform",
    light_paths: float | str = "always",
    sample_direct: bool = True,
    technique_images: str = "",
    next_event: str | Plugin = ...,
    directions: str | Plugin = ...,
    roulette: str | Plugin = ...,
    shadow_test: str | Plugin = ...,
    max_depth: int = -1,
    rr_depth: int = 5,
    hide_emitters: bool = False,
    timeout: float = -1,
    checkpoint: str = "",
    checkpoint_every: str = "60s",
    aovs: str = "",
    id: str = ...,
) -> dict[str, Any]:
    """Vertex connection and merging (vcm).

    Combines bidirectional path tracing (bdpt) and photon mapping: light that arrives near a vertex
    of a camera path counts at that vertex as well (merging), with MIS weights over all techniques.

    Parameters:
        merging (string): Where vertices are merged: with caustics, only where light arrives from a
            mirror or smooth glass; with all, on all rough surfaces and in all media, as in the
            sources; with none, nowhere, which makes the integrator bdpt. (Default: caustics)
        radius (float): Radius within which vertices are merged in a first pass of one sample per
            pixel, in units of the scene. (Default: 0)
        radius_in_media (float): As radius, for vertices in participating media, which are merged in
            a ball: a pass of k samples per pixel uses 1/k of the volume. (Default: 0)
        radius_decay (float): α, in (0, 1]: the squared radius of pass i (in media, its cube) is the
            squared radius (or cube) of the first pass times i to the power of α − 1. (Default:
            0.75)
        connections (int): How many vertices of light paths, chosen at random, each vertex of a
            camera path is connected to; 0 for none. (Default: 1)
        light_image (bool): Whether to connect light paths to the sensor as well (t = 1). (Default:
            true)
        subpath_selection (string): How the vertices of light paths are chosen: uniform, or by
            visibility, which prefers regions whose vertices were visible from the camera path's
            vertex, and contributed light, in the pilot samples. (Default: uniform)
        light_paths (float or string): Number of light paths per camera path, from 0 (camera paths
            alone) to 64; or always, which is 1; or auto: pilot samples measure whether 0, 1/16,
            1/4, 1 or 4 light paths are most efficient in a render of this length, together with
            connections, two or four times as many connections, or none. (Default: always)
        sample_direct (bool): Whether to connect camera paths to points sampled on lights (s = 1).
            (Default: true)
        technique_images (string): Name of an OpenEXR file to which the image of each technique is
            written, with and without its MIS weights (layers weighted.s1_t2 and plain.s1_t2, with s
            vertices on the light path and t on the camera path), for paths of up to 8 segments.
            (Default: none)
        next_event, directions, roulette, shadow_test (string or decision): Decisions of the camera
            paths, as in composed_path. (Default: as in path)
        max_depth (int): Longest path in the image, -1 for no limit. (Default: -1)
        rr_depth (int): Path depth at which Russian roulette on the throughput begins. (Default: 5)
        hide_emitters (bool): Hide directly visible emitters. (Default: false)
        timeout (float): Seconds after which to stop, learning and compilation included; 0 or less
            for no limit. (Default: -1)
        checkpoint (string): A folder in which the render is saved: a second render (of the same
            scene, seed and parameters) continues from there, up to spp, which may be higher than
            before. (Default: none)
        checkpoint_every (string): How often it is saved: 60s, 10m, 2h or 100spp. (Default: 60s)
        aovs (string): Arbitrary output variables, in the syntax of Mitsuba's aov integrator, such
            as depth:depth,nn:sh_normal. (Default: none)
    """


def goniometric_area(
    *,
    radiance: Spectrum | Texture = 1,
    exponent: float = 10,
    filename: str = ...,
    sampling_weight: float = 1,
    id: str = ...,
) -> dict[str, Any]:
    """Area light with an angular profile (goniometric_area).

    An area light whose radiance depends on direction: by a power of the cosine with the normal, or
    by the intensities of a photometric file (IES). Each point of the surface has the same profile.

    Parameters:
        radiance (spectrum or texture): Radiance by which the profile is multiplied, in W/(m² sr).
            (Default: 1)
        exponent (float): The radiance is proportional to this power of the cosine, 0 or more.
            (Default: 10)
        filename (string): Instead of exponent: a photometric file (IES LM-63, type C).
        sampling_weight (float): How often the light is chosen, relative to other lights. (Default:
            1)
    """


def moving_light(
    *,
    nested: Plugin = ...,
    pose_0: Transform = ...,
    pose_1: Transform = ...,
    time_0: float = ...,
    time_1: float = ...,
    translate: Vector | float = ...,
    axis: Vector | float = ...,
    angle: Vector | float = ...,
    center: Vector | float = ...,
    begin: Vector | float = ...,
    end: Vector | float = ...,
    id: str = ...,
    **numbered: Any,
) -> dict[str, Any]:
    """Moving light (moving_light).

    Moves a nested point light, spot light or projector rigidly while the shutter is open. Each path
    sees the emitter in its pose at the time of the path.

    Parameters:
        (nested plugin) (emitter): The emitter that moves, exactly one: point, spot or projector.
        pose_0, pose_1, … (transform): Rotations and translations through which the emitter passes.
        time_0, time_1, … (float): The times of the poses, one for each pose, in increasing order,
            in the units of the sensor's shutter_open and shutter_close.
        translate, axis, angle, center, begin, end (vector, float): In place of poses: a
            displacement and a rotation at constant speed; see moving.
    """


def solid_angle_area(
    *,
    radiance: Spectrum | Texture = 1,
    sampling: str = "solid_angle",
    sampling_weight: float = 1,
    id: str = ...,
) -> dict[str, Any]:
    """Area light, sampled by solid angle (solid_angle_area).

    An area light for a shape, which emits like Mitsuba's area, but is sampled differently: a
    connection samples a direction in the solid angle that the light subtends at the illuminated
    point, instead of a point on the light's surface.

    Parameters:
        radiance (spectrum or texture): Emitted radiance, in W/(m² sr). (Default: 1)
        sampling (string): Directions are sampled by solid_angle, or by projected solid angle, which
            includes the cosine with the normal of the illuminated surface (rectangles only).
            (Default: solid_angle)
        sampling_weight (float): How often the light is chosen, relative to other lights. (Default:
            1)
    """


def dispersive_dielectric(
    *,
    int_ior: str | float = "bk7",
    cauchy: str = ...,
    sellmeier: str = ...,
    ext_ior: str | float = ...,
    specular_reflectance: Spectrum | Texture = 1,
    specular_transmittance: Spectrum | Texture = 1,
    id: str = ...,
) -> dict[str, Any]:
    """Smooth dispersive dielectric (dispersive_dielectric).

    A smooth surface between air and a glass whose refractive index depends on the wavelength, so
    that a prism spreads white light into a spectrum. Otherwise it is Mitsuba's dielectric.

    Parameters:
        int_ior (string or float): The material inside: bk7, bak4, f2, sf6, sf10, sf11, n-sf6,
            n-sf11, fused silica, water, diamond, sapphire (ordinary ray), or a number for an index
            that is the same at all wavelengths. (Default: bk7)
        cauchy (string): Instead of int_ior: the coefficients "A, B" or "A, B, C" of the index A +
            B/λ² + C/λ⁴, with λ in µm.
        sellmeier (string): Instead of int_ior: the coefficients "B1, B2, B3, C1, C2, C3" of the
            index whose square is 1 + Σ Bλ²/(λ² - C), with λ in µm and C in µm².
        ext_ior (string or float): The index outside: a number, or vacuum, helium, hydrogen, air,
            carbon dioxide. (Default: air, 1.000277)
        specular_reflectance, specular_transmittance (spectrum or texture): Factors of reflection
            and refraction, 0 to 1; leave them at 1 for physical results. (Default: 1)
    """


def dispersive_roughdielectric(
    *,
    int_ior: Any = ...,
    cauchy: Any = ...,
    sellmeier: Any = ...,
    ext_ior: Any = ...,
    distribution: str = "beckmann",
    alpha: float | Texture = 0.1,
    alpha_u: float | Texture = ...,
    alpha_v: float | Texture = ...,
    sample_visible: bool = True,
    specular_reflectance: Spectrum | Texture = 1,
    specular_transmittance: Spectrum | Texture = 1,
    id: str = ...,
) -> dict[str, Any]:
    """Rough dispersive dielectric (dispersive_roughdielectric).

    A frosted surface of microfacets between air and a glass whose refractive index depends on the
    wavelength. Otherwise it is Mitsuba's roughdielectric.

    Parameters:
        int_ior, cauchy, sellmeier, ext_ior (several): As in dispersive_dielectric. (Default:
            int_ior bk7, ext_ior air)
        distribution (string): The distribution of microfacets: beckmann or ggx. (Default: beckmann)
        alpha (float or texture): Roughness, not negative: the root mean square slope of
            microfacets. (Default: 0.1)
        alpha_u, alpha_v (float or texture): Instead of alpha: roughness along the tangent and the
            bitangent.
        sample_visible (bool): Whether to sample only visible microfacets, which is less noisy.
            (Default: true)
        specular_reflectance, specular_transmittance (spectrum or texture): Factors of reflection
            and refraction, 0 to 1; leave them at 1 for physical results. (Default: 1)
    """


def faure(
    *,
    sample_count: int = 4,
    seed: int = 0,
    dimensions: int = 4,
    id: str = ...,
) -> dict[str, Any]:
    """Faure sequence (faure).

    Points of the Faure sequence. If the number of samples is a power of its base (2, 5, 7 or 11 for
    2, 4, 6 or 8 dimensions), they are stratified as well as possible in all projections onto any of
    its dimensions.

    Parameters:
        sample_count (int): Samples per pixel: any number. (Default: 4)
        seed (int): Added to the seed of the render. (Default: 0)
        dimensions (int): Number of dimensions that are stratified together: 2, 4, 6 or 8. (Default:
            4)
    """


def focal_points(
    *,
    boxes: int = 32,
    always_use: bool = False,
    id: str = ...,
) -> dict[str, Any]:
    """Focal points (focal_points).

    A decision for the slot scattering of composed_path. It learns from the first samples where in
    space light passes: keyholes, slits, gaps of doors, windows, bright spots, and the real and
    virtual images behind lenses and mirrors. A share of the directions of a path then lead there,
    and the BSDF samples the others. It is unbiased, and needs no knowledge of portals.

    Parameters:
        boxes (int): The most boxes that stand for these places, up to 256. (Default: 32)
        always_use (bool): Whether directions lead to focal points even if the pilots show that this
            does not pay. (Default: false)
    """


def guided_directions(
    *,
    regions: str = "surfaces",
    tile: int = 16,
    bounces: int = ...,
    always_guide: bool = False,
    max_memory: float = 512,
    id: str = ...,
) -> dict[str, Any]:
    """Guided directions (guided_directions).

    A decision for the slot directions of composed_path. It learns from the first samples which
    random numbers lead the BSDF to sample directions from which light comes, and draws these
    numbers more often. It is unbiased, needs no knowledge of materials and lights, and guides all
    BSDFs in the same way. pss_guided is a path tracer with this decision.

    Parameters:
        regions (string): What a tree of samples belongs to. surfaces: a voxel and a side of the
            surfaces in it, or a voxel of a medium; every bounce uses the tree of its place. tiles:
            a tile of the film, as in the thesis; the sample of a path's first bounce decides which
            tree the second uses, and so on. (Default: surfaces)
        tile (int): Edge of a tile in pixels; accepted only with tiles. (Default: 16)
        bounces (int): Maximum number of directions of a path that are guided, up to 64 (with tiles,
            up to 5). (Default: 6; 2 with tiles)
        always_guide (bool): Whether to guide all bounces, even if the pilots show that guiding does
            not pay. (Default: false)
        max_memory (float): Memory for what is recorded and learned, in MiB. (Default: 512)
    """


def halton(
    *,
    sample_count: int = 4,
    seed: int = 0,
    dimensions: int = 4,
    id: str = ...,
) -> dict[str, Any]:
    """Halton sequence (halton).

    Points of the Halton sequence: the radical inverse of the sample's index, in a different prime
    base for each dimension, with randomly permuted digits.

    Parameters:
        sample_count (int): Samples per pixel: any number. (Default: 4)
        seed (int): Added to the seed of the render. (Default: 0)
        dimensions (int): Number of dimensions that are stratified together: 2, 4, 6 or 8. (Default:
            4)
    """


def hammersley(
    *,
    sample_count: int = 4,
    seed: int = 0,
    dimensions: int = 4,
    id: str = ...,
) -> dict[str, Any]:
    """Hammersley set (hammersley).

    Points of the Hammersley set: the first dimension is the sample's index divided by the number of
    samples, and the others are the same as in halton.

    Parameters:
        sample_count (int): Samples per pixel: any number. (Default: 4)
        seed (int): Added to the seed of the render. (Default: 0)
        dimensions (int): Number of dimensions that are stratified together: 2, 4, 6 or 8. (Default:
            4)
    """


def latin_hypercube(
    *,
    sample_count: int = 4,
    seed: int = 0,
    id: str = ...,
) -> dict[str, Any]:
    """Latin hypercube (latin_hypercube).

    Each random number of a path is stratified separately: [0, 1) is divided into as many intervals
    as there are samples, and each interval gets one number.

    Parameters:
        sample_count (int): Samples per pixel: any number. (Default: 4)
        seed (int): Added to the seed of the render. (Default: 0)
    """


def lattice(
    *,
    sample_count: int = 4,
    seed: int = 0,
    dimensions: int = 4,
    id: str = ...,
) -> dict[str, Any]:
    """Rank-1 lattice (lattice).

    Multiples of one vector, modulo 1, with a random shift in each dimension. The vector works well
    for any power of two of samples.

    Parameters:
        sample_count (int): Samples per pixel: any number. (Default: 4)
        seed (int): Added to the seed of the render. (Default: 0)
        dimensions (int): Number of dimensions that are stratified together: 2, 4, 6 or 8. (Default:
            4)
    """


def learned_lights(
    *,
    target: str = "contribution",
    grid: int = ...,
    max_memory: float = 512,
    id: str = ...,
) -> dict[str, Any]:
    """Learned lights (learned_lights).

    A decision for the slot next_event of composed_path. It learns from the first samples which
    lights reach which surfaces, and samples lights accordingly, including parts of large lights and
    directions of the sky. It is unbiased. neepp is a path tracer with this decision.

    Parameters:
        target (string): What determines the probability of a light, for each voxel and side of a
            surface: its contribution (the light that arrived from it), or its visibility (how often
            it was visible, times its unoccluded contribution). (Default: contribution)
        grid (int): Number of voxels along each axis of the region in which paths scatter, 1 to
            1024. (Default: 16, or fewer if the pilots have few samples for the number of visible
            voxels and lights)
        max_memory (float): Memory for what is learned, in MiB. (Default: 512)
    """


def mis_heuristic(
    *,
    heuristic: str = "power",
    exponent: float = 2,
    threshold: float = 0.1,
    id: str = ...,
) -> dict[str, Any]:
    """Multiple importance sampling heuristic (mis_heuristic).

    A decision for the slot mis of composed_path. Two techniques find the same light: connections to
    it, and BSDF samples that hit it. The heuristic weights both by their densities in a way that
    keeps the image unbiased.

    Parameters:
        heuristic (string): power (weights proportional to a power of the densities), balance
            (weights proportional to the densities), cutoff (as balance, but a technique whose
            density is much smaller than the other one has weight 0), maximum (the technique with
            the larger density has weight 1), bsdf (BSDF samples only, with connections to light
            that they cannot find), or light (connections only, with BSDF samples for light that
            connections cannot find). (Default: power)
        exponent (float): The exponent of power, 1 to 64. (Default: 2)
        threshold (float): The threshold of cutoff, 0 to 1: a technique whose density is below this
            fraction of the other one has weight 0. (Default: 0.1)
    """


def portal_lights(
    *,
    share: float = 0.9,
    id: str = ...,
) -> dict[str, Any]:
    """Portal-masked environment sampling (portal_lights).

    A decision for the slot next_event of composed_path. From each vertex, it samples the part of
    the environment visible through openings, in proportion to its radiance. Shapes of type portal
    mark these openings.

    Parameters:
        share (float): The share of the connections to the environment that are sampled through
            portals, 0 to 0.99. (Default: 0.9)
    """


def resampled_lights(
    *,
    candidates: int = 8,
    id: str = ...,
) -> dict[str, Any]:
    """Resampled lights (resampled_lights).

    A decision for the slot next_event of composed_path: resampled importance sampling. Each
    connection draws several candidates. These are light samples, as in path; if there is an
    environment, half of the candidates are BSDF samples, which are looked up in it. The connection
    evaluates BSDF and light for all candidates, chooses one in proportion to its unoccluded
    contribution, and traces one shadow ray.

    Parameters:
        candidates (int): Number of candidates of a connection, 1 to 1024. (Default: 8)
    """


def sobol_owen(
    *,
    sample_count: int = 4,
    seed: int = 0,
    dimensions: int = 4,
    blue_noise: bool = False,
    film_width: int = ...,
    id: str = ...,
) -> dict[str, Any]:
    """Sobol' sequence with Owen scrambling (sobol_owen).

    Points of the Sobol' sequence, with Owen scrambling of their digits and of their order. If the
    number of samples is a power of two, they are stratified in each pair of dimensions that a path
    draws together. The same holds for every aligned range of samples whose length is a power of
    two.

    Parameters:
        sample_count (int): Samples per pixel: any number. (Default: 4)
        seed (int): Added to the seed of the render. (Default: 0)
        dimensions (int): Number of dimensions that are stratified together: 2, 4, 6 or 8. (Default:
            4)
        blue_noise (bool): Whether the pixels share the points of one sequence, so that the errors
            of neighbouring pixels cancel: the noise that remains is fine-grained, and disappears
            when the image is blurred. (Default: false)
        film_width (int): Width of the image in pixels (of the crop window, including the border if
            that is sampled), for blue_noise with mi.render and an integrator of Mitsuba. (Default:
            0, unknown)
    """


def spatial_lights(
    *,
    grid: int = ...,
    max_memory: float = 512,
    id: str = ...,
) -> dict[str, Any]:
    """Spatial light distribution (spatial_lights).

    A decision for the slot next_event of composed_path. It chooses a light in proportion to its
    unoccluded contribution to the voxel of the vertex. These contributions are computed before the
    first sample, and nothing is learned.

    Parameters:
        grid (int): Number of voxels along each axis of the scene's bounding box, 1 to 1024.
            (Default: 32, or what fits into the memory)
        max_memory (float): Memory for the table of probabilities, in MiB. (Default: 512)
    """


def two_stage_lights(
    *,
    splits: int = 16,
    vertices: str = "first",
    visibility: str = "unknown",
    reallocated: float = 0.9,
    id: str = ...,
) -> dict[str, Any]:
    """Two-stage importance sampling (two_stage_lights).

    A decision for the slot next_event of composed_path. It samples directions of the environment
    (envmap, sunsky, constant) in proportion to an estimate of the product of map and BSDF. Each
    vertex divides the map into rectangles, which are smaller where the BSDF varies more, and
    evaluates the BSDF at their corners. Sums of the map over rectangles come from a summed-area
    table. Within a rectangle, samples are warped by the texels of the map.

    Parameters:
        splits (int): Maximum number of times that a vertex divides rectangles, in addition to the
            first division into eight, 0 to 1024. (Default: 16)
        vertices (string): Which vertices of a path divide the map: the first, or all. (Default:
            first)
        visibility (string): How connections of first vertices take occlusion into account: not at
            all (unknown), or by visibility maps that a pilot has learned, over random numbers
            (primary) or over directions (world). (Default: unknown)
        reallocated (float): With visibility maps: the share of the connections that the maps
            sample, 0 to 0.99. (Default: 0.9)
    """


def visibility_roulette(
    *,
    law: str = "affine",
    slope: float = 10,
    floor: float = 0.1,
    grid: int = 16,
    max_memory: float = 512,
    refine: int = 16,
    id: str = ...,
) -> dict[str, Any]:
    """Visibility roulette (visibility_roulette).

    A decision for the slot shadow_test of composed_path. It learns from the first samples how often
    the lights are visible from each part of the scene, and rejects most of the shadow rays that
    would be blocked. The connections that are tested are weighted by the inverse of this
    probability, so the image is unbiased.

    Parameters:
        law (string): How the probability of tracing a shadow ray follows from the learned
            visibility V: affine for min(1, slope · V + floor), paper for max(V, 1e-4), as printed
            in the source, which traces fewer rays and is much noisier. (Default: affine)
        slope (float): Slope of the affine law; accepted only with that law. (Default: 10)
        floor (float): Lowest probability of the affine law, 1e-6 to 1; accepted only with that law.
            (Default: 0.1)
        grid (int): Number of voxels along each axis of the scene's bounding box, 1 to 1024.
            (Default: 16)
        max_memory (float): Memory for what is learned, in MiB. (Default: 512)
        refine (int): Number of random visibility tests added to each pair of voxels (one of which
            contains a light) between which the pilots found an unoccluded ray; at most 1024.
            (Default: 16)
    """


def weighted_connections(
    *,
    count: int = 16,
    vertices: str = "first",
    pattern: str = "hammersley",
    weights: str = "",
    id: str = ...,
) -> dict[str, Any]:
    """Weighted connections (weighted_connections).

    A decision for the slot connections of composed_path. It connects a vertex to many points on
    lights, whose random numbers come from well distributed point sets. Each connection can be
    weighted by the Voronoi cell of its point. reweighted_direct is a path tracer with this
    decision.

    Parameters:
        count (int): Number of points in a set, which is the number of connections of a vertex; at
            most 4096 (1024 with poisson_disk). (Default: 16)
        vertices (string): Which vertices of a path have this many connections: the first (later
            ones have one), or all. (Default: first)
        pattern (string): How the points of a set are distributed: independent, stratified,
            latin_hypercube, halton, hammersley, sobol, lattice or poisson_disk; see
            mitsuba_ext.util.pointsets.points. (Default: hammersley)
        weights (string): Weights of the points: none (all equal), torus (areas of periodic Voronoi
            cells: unbiased), unbiased (the same, with points mapped by 1 - |2u - 1|, which removes
            discontinuities at the border), or voronoi (cells that end at the border, as in the
            thesis: slightly biased). (Default: none)
    """


def weighted_numbers(
    *,
    pattern: str = "lattice",
    weights: str = "",
    id: str = ...,
) -> dict[str, Any]:
    """Weighted numbers (weighted_numbers).

    A decision for the slots aperture, time and wavelength of composed_path. It takes the random
    numbers that choose the point on the aperture, the time, or the wavelengths of a camera ray from
    well distributed point sets. Each sample can be weighted by the Voronoi cell of its point. Each
    pixel uses one set for all of its samples, chosen and shifted at random.

    Parameters:
        pattern (string): How the points of a set are distributed: independent, stratified,
            latin_hypercube, halton, hammersley, sobol, lattice or poisson_disk; see
            mitsuba_ext.util.pointsets.points. (Default: lattice)
        weights (string): Weights of the points: none (all equal), torus (areas or lengths of
            periodic Voronoi cells: unbiased), unbiased (the same, with points mapped by 1 - |2u -
            1|, which removes discontinuities at the border; not for wavelengths, which have no
            discontinuity there, because both ends of the spectrum are dark), or voronoi (cells that
            end at the border, as in the thesis: slightly biased). (Default: none)
    """


def moving_camera(
    *,
    nested: Plugin = ...,
    pose_0: Transform = ...,
    pose_1: Transform = ...,
    time_0: float = ...,
    time_1: float = ...,
    translate: Vector | float = ...,
    axis: Vector | float = ...,
    angle: Vector | float = ...,
    center: Vector | float = ...,
    begin: Vector | float = ...,
    end: Vector | float = ...,
    id: str = ...,
    **numbered: Any,
) -> dict[str, Any]:
    """Moving camera (moving_camera).

    Moves the nested sensor rigidly while its shutter is open: a pan, a tracking shot, a shaken
    camera. Each ray is a ray of the nested sensor, in the sensor's pose at the time of the ray.

    Parameters:
        (nested plugin) (sensor): The sensor that moves, exactly one: perspective, thinlens,
            orthographic, radiancemeter or batch.
        pose_0, pose_1, … (transform): Rotations and translations through which the sensor passes.
        time_0, time_1, … (float): The times of the poses, one for each pose, in increasing order,
            in the units of the shutter interval.
        translate, axis, angle, center, begin, end (vector, float): In place of poses: a
            displacement and a rotation at constant speed, which begin at the sensor's own to_world;
            see moving.
    """


def heightfield(
    *,
    filename: str = ...,
    bitmap: Any = ...,
    data: Any = ...,
    scale: float = 1,
    to_world: Transform = ...,
    face_normals: bool = False,
    flip_normals: bool = False,
    nested: Plugin | Sequence[Plugin] = ...,
    id: str = ...,
) -> dict[str, Any]:
    """Heightfields (heightfield).

    A regular grid of heights from an image: terrain, relief, waves. Each cell of the grid consists
    of two triangles, which are not stored: heights and acceleration structure take 5.4 bytes per
    cell, or 3.4 if the image has 8 or 16 bits. A mesh of the same triangles takes about 200 bytes
    per cell in Mitsuba.

    Parameters:
        filename (string): The image: PNG, EXR and all other formats that bitmap reads.
        bitmap (bitmap): In place of filename: an image in memory (from Python only).
        data (tensor): In place of filename: a tensor of shape (rows, columns) or (rows, columns,
            channels) (from Python only).
        scale (float): The height of the value 1, before to_world. (Default: 1)
        to_world (transform): Places the heightfield. (Default: none, i.e. identity)
        face_normals (bool): Whether shading normals are the normals of the triangles. (Default:
            false)
        flip_normals (bool): Whether normals point down, towards lower z, instead of up. (Default:
            false)
        (nested plugin) (bsdf or several): The material, and the media interior (below) and exterior
            (above).
    """


def lightweight_mesh(
    *,
    nested: Plugin = ...,
    quantized: bool = False,
    id: str = ...,
) -> dict[str, Any]:
    """Lightweight meshes (lightweight_mesh).

    Finds the triangles of a nested mesh with an acceleration structure of 3.3 bytes per triangle.
    Embree's structure, in Mitsuba, takes about 70 bytes per triangle, and 110 while it is built.

    Parameters:
        (nested plugin) (shape): The mesh: ply, obj, serialized, or any other shape that Mitsuba
            represents by triangles, with its material, and with its light or media, if it has any.
        quantized (bool): Whether vertices are rounded to 65536 steps along each axis of the mesh's
            bounding box, normals to steps of a few thousandths of a degree, and texture coordinates
            to 65536 steps between their smallest and largest value. (Default: false)
    """


def moving(
    *,
    nested: Plugin = ...,
    translate: Vector = ...,
    axis: Vector = ...,
    angle: float = ...,
    center: Vector = ...,
    begin: float = ...,
    end: float = ...,
    pose_0: Transform = ...,
    pose_1: Transform = ...,
    time_0: float = ...,
    time_1: float = ...,
    id: str = ...,
    **numbered: Any,
) -> dict[str, Any]:
    """Moving shapes (moving).

    Moves the nested shapes together, as a rigid body, while the shutter is open. The integrators of
    this package render their motion blur, including its shadows, reflections and indirect light.

    Parameters:
        (nested plugin) (shape): The shapes that move, one or more, of any type, with their
            materials.
        translate (vector): The total displacement, at constant velocity. (Default: 0, 0, 0)
        axis (vector): The axis about which they rotate, at constant speed; it need not be of unit
            length. (Default: none)
        angle (float): The total rotation in degrees; it may exceed 360.
        center (point): A point on the axis, before the motion; it is displaced with the shapes.
            (Default: 0, 0, 0)
        begin, end (float): When the motion begins and ends, in the units of the sensor's
            shutter_open and shutter_close. (Default: 0 and 1)
        pose_0, pose_1, … (transform): In place of the parameters above: rotations and translations
            through which the shapes pass.
        time_0, time_1, … (float): The times of the poses, one for each pose, in increasing order.
    """


def portal(
    *,
    to_world: Transform = ...,
    id: str = ...,
) -> dict[str, Any]:
    """Portals (portal).

    Marks a rectangular opening through which the environment lights a room: a window, a door, a
    skylight. The decision portal_lights of composed_path samples the part of the environment that
    is visible through it.

    Parameters:
        to_world (transform): Places the square from (−1, −1, 0) to (1, 1, 0), the same as for
            rectangle, on the opening. (Default: none, i.e. identity)
    """
