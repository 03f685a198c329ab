"""Estimates of an image while the scene changes, with a control variate from the last step."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

#: The share of what was known about the noise that a new step keeps.
_KEPT = 0.9

#: Pixels on each side, along each axis, over which the noise is averaged.
_RADIUS = 4


# Not a dataclass: Dr.Jit would look for arrays in it, as an attribute of a scene's own integrator
class RecursiveEstimate:
    r"""The image of a scene that changes from step to step. Step :math:`i` renders

    - :math:`f_i`, the scene as it is now, with random numbers :math:`s_i`,
    - :math:`h_{i+1}`, the same scene with random numbers :math:`s_{i+1}`, for the next step.

    :math:`h_i` and :math:`f_i` have the same random numbers, so :math:`h_i` is a control variate
    of :math:`f_i`. The last estimate :math:`F_{i-1}` has the same expected value as :math:`h_i`:

    .. math:: F_i = f_i + α_i (F_{i-1} - h_i)

    The weight :math:`α_i = \mathrm{Cov}(f_i, h_i) / (\mathrm{Var}\,h_i + \mathrm{Var}\,F_{i-1})`
    has the least variance. It depends on earlier steps only. Their differences tell the noise
    without any mean value: :math:`f_{i-1} - h_i` shows the same scene with independent numbers, so
    half its square estimates :math:`v = \mathrm{Var}\,h`. The change :math:`x_i = f_i - h_i` has
    the variance :math:`d`, of which half the square of :math:`x_i - x_{i-1}` is an estimate (too
    large where the change itself differs from step to step, which makes α smaller). With
    :math:`\mathrm{Var}\,f = v`, :math:`\mathrm{Cov} = v - d/2`, :math:`δ = d / v` and
    :math:`r_i = \mathrm{Var}\,F_i / v`,

    .. math:: α_i = \frac{1 - δ/2}{1 + r_{i-1}}, \quad r_i = (1 - α_i)^2 + α_i δ + α_i^2 r_{i-1}.

    :math:`v` and :math:`d` are running means over the steps, averaged over a window of 9x9 pixels.
    A weight that depended on single pixels would favour values of one sign. Where a render has a
    value that is not finite, the weight is 0, so that such values do not stay in the image.

    Source: B. Nicolet, F. Rousselle, J. Novák, A. Keller, W. Jakob, T. Müller, *Recursive Control
    Variates for Inverse Rendering*, ACM Transactions on Graphics 42(4), 2023. There, moments come
    from the values of all steps.

    Attributes:
        weight: The weights :math:`α` of the last step, shape [y, x, channel]; 0 in the first step.
    """

    def __init__(self) -> None:
        self.weight = mi.TensorXf()
        self._image: mi.TensorXf | None = None
        self._steps = 0

    def add(self, rendered: mi.TensorXf) -> mi.TensorXf:
        """
        Parameters:
            rendered: :math:`f_i`, with the same random numbers as the last :math:`h`.

        Returns:
            :math:`F_i`.
        """
        if self._image is None:
            self._image, self.weight = rendered, dr.zeros(mi.TensorXf, rendered.shape)
        else:
            change = _finite(rendered - self._control)
            weight = self._best_weight()
            correction = weight * (self._image - self._control)
            self.weight = dr.select(dr.isfinite(correction), weight, 0)
            self._image = rendered + _finite(correction)
            self._learn(change)
            self._change = change
        self._rendered = rendered
        dr.eval(self.__dict__)
        return self._image

    def prepare(self, control: mi.TensorXf) -> None:
        """
        Parameters:
            control: :math:`h_{i+1}`.
        """
        self._control = control
        dr.eval(control)

    def _best_weight(self) -> mi.TensorXf:
        """Between 0 (the change is as noisy as two independent images) and 1."""
        if self._steps == 0:
            # Nothing is known: best if the scene hardly changes, 1.5 times the variance if all does
            return dr.full(mi.TensorXf, 0.5, self._image.shape)
        return (1 - 0.5 * self._noise_ratio()) / (1 + self._variance_ratio)

    def _noise_ratio(self) -> mi.TensorXf:
        """δ, at most 2."""
        v, d = self._noise, self._noise_of_change
        return dr.select(d < 2 * v, d / v, dr.select(d > 0, 2, 0))

    def _learn(self, change: mi.TensorXf) -> None:
        """Updates the noise, and the variance of the image, with what this step shows."""
        noise = 0.5 * _window_means(_finite(dr.square(self._rendered - self._control)))
        if self._steps == 0:
            self._noise = noise
            self._noise_of_change = _window_means(dr.square(change))
            self._variance_ratio = dr.full(mi.TensorXf, 1, change.shape)
        else:
            of_change = 0.5 * _window_means(dr.square(change - self._change))
            # A mean over all steps at first
            new = dr.opaque(mi.Float, max(1 - _KEPT, 1 / (self._steps + 1)))
            self._noise = dr.lerp(self._noise, noise, new)
            self._noise_of_change = dr.lerp(self._noise_of_change, of_change, new)
        α = self.weight
        self._variance_ratio = (
            dr.square(1 - α) + α * self._noise_ratio() + dr.square(α) * self._variance_ratio
        )
        self._steps += 1


def _finite(image: mi.TensorXf) -> mi.TensorXf:
    return dr.select(dr.isfinite(image), image, 0)


def _window_means(image: mi.TensorXf) -> mi.TensorXf:
    """The mean over each pixel and its neighbours, shape [y, x, channel]."""
    height, width, channels = image.shape
    values = image.array
    # Opaque: images of all sizes share the kernels
    for size, stride in ((width, channels), (height, width * channels)):
        dr.eval(values)
        values = _means_along(values, *(dr.opaque(mi.Int32, x) for x in (size, stride)))
    return mi.TensorXf(values, image.shape)


def _means_along(values: mi.Float, size: mi.Int32, stride: mi.Int32) -> mi.Float:
    entry = dr.arange(mi.Int32, len(values))
    place = entry // stride % size
    total, count = mi.Float(0), mi.Float(0)
    for offset in range(-_RADIUS, _RADIUS + 1):
        is_inside = (place + offset >= 0) & (place + offset < size)
        total += dr.gather(mi.Float, values, entry + offset * stride, is_inside)
        count += dr.select(is_inside, 1, 0)
    return total / count
