"""The time that decisions take: every constant of time, from measurements.

They are constants because with measured times two renders of the same seed could choose
differently, above all on a busy machine.
"""

from __future__ import annotations

#: The time of a segment of a path (its ray, its BSDF, the choice of a light), of a shadow ray, and
#: of choosing a light from a table: the unit of all times here that have no other one. (A fit to
#: light paths, see below, and to ten scenes with a table: predictions within 0.06 of the measured
#: time, except in showroom, where paths with the table take 0.88 of the time.)
SEGMENT, SHADOW, TABLE = 1.35, 0.5, 0.05

#: The time of a sample with a light tree, relative to ``path``, less the time with a table (0.0 to
#: 0.1 in eight scenes of ``many_lights.py``).
TREE = 0.05

#: The time of partial sums along a segment of a camera path, of a segment of a light path, of a
#: connection of each vertex, and of its shadow ray. With merging: of a vertex that is put into the
#: grid, and of a vertex or cell that is looked at. (A fit to seven sets of techniques without
#: merging in 14 scenes, and to three, two of them with merging, in seven: 0.91 of the times within
#: 1.2. spotlights takes 1.1 to 1.6 times as long.)
SUMS, LIGHT_SEGMENT, CONNECTION, CONNECTED, GRID, LOOK = 0.17, 3.1, 0.3, 1.3, 0.7, 0.1

#: The time of guiding the first direction of a path, and each further one, in units of the time of
#: a ray (medians over 15 scenes; the first: 0.3 to 1). The number of rays per segment of a path,
#: shadow rays included.
FIRST_GUIDED, GUIDED, RAYS_PER_SEGMENT = 0.7, 0.25, 1.5

#: The time of a sample with guided distances in media, relative to one without.
GUIDED_FLIGHTS = 1.25

#: The time of mixing directions to focal points with BSDF samples, and the time of each box, as
#: shares of the time of a sample. (With 32 boxes: keyhole 1.2 times the time of ``path``, a slit
#: in a wall 1.7, cornell_box, whose paths are cheap, above 2.)
FOCAL_CHOICE, FOCAL_BOX = 0.1, 0.02

#: The candidates of resampled lights, and the connections to lights, that take about as long as a
#: path.
CANDIDATES_PER_PATH, CONNECTIONS_PER_PATH = 32, 16

#: The time of an entry of a light map, all stages together, in units of the time of a sample.
MAP_ENTRY = 1 / 3

#: What swarming maps take besides the time of a sample, as a share of it: drawing from them about
#: 0.05, and learning them.
SWARMING = 0.079

#: The time of the first trial of a chain, and of each further one, in the unit of ``SEGMENT``.
FIRST_CHAIN, CHAIN_TRIAL = 10.0, 5.0

#: What a learned choice among vertices of light paths takes besides the time of a sample, as a
#: share of it: 0.2, of which half is made up by MIS weights that rely on the connections (they
#: double the predicted gain).
SUBPATH_CHOICE = 0.103

#: The share of shadow rays that must be rejected for the lookups to save time. By this measure
#: staircase has 0.05, kitchen 0.07 (which about breaks even), veach-ajar 0.2, door_ajar 0.5.
REJECTION = 0.05

#: The kernels that a render with learning compiles, in units of the time of a kernel of ``path``:
#: the kernels of its pilots, and of the last stage, are larger, and there are many small ones. The
#: same for the trial of light paths.
LEARNING_KERNELS, TRIAL_KERNELS = 6, 4

#: The time to compile the kernels of light paths, in samples of ``path``: as long as two million,
#: divided by the number of renders that share the kernels, about four.
LIGHT_PATH_KERNELS = 5e5
