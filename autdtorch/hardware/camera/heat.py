"""The pressure in a plane from frames of a screen that it heats.

|p|^2 is a sum of cosines in a rectangle around the plane (`Cosines`). The screen responds to each with a rate
of its own (`Screen`), and the camera adds constants, offsets and noise (`PulseFit`). All that is linear in
|p|^2, and is solved by weighted least squares with a prior: pixels that are dead or saturated have no weight,
and nothing is filled in.

Deviations are by noise. Errors of the screen's constants, of the registration and of the camera's lag add to
them: 0.1 to 0.4 % of |p| measured with an emulated camera, more than the noise above about 3 kPa.

The prior has the variance of the strongest place at every place, much more than a field has on average. So
it shrinks |p|^2 by no more than about the square of its relative standard deviation.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from scipy.optimize import least_squares

from autdtorch.hardware.camera.picture import Picture, clarity
from autdtorch.hardware.camera.pulse_fit import PulseFit
from autdtorch.hardware.camera.registration import Registration
from autdtorch.hardware.camera.screen import Cosines, Screen
from autdtorch.objectives.readings import deviation_by_square
from autdtorch.utils.array_types import Array
from autdtorch.utils.validation import (
    ArrayLike,
    finite_number,
    gappy_tensor,
    invalid,
    not_negative,
    positive,
    positive_integers,
    real_tensor,
    require_kind,
)

_DRIFT = 0.02  # of all pixels [K/s], standard deviation
_LATE = 0.1  # unit of a latency that is fitted with a screen [s]
_FARTHEST = 3.0  # of a fitted screen from the one assumed: logarithms of factors, and latencies
_SMOOTH = 0.2  # length over which the density of pixels is smoothed, in wavelengths
_UNSEEN = 0.1  # of the median density of pixels
_SOUND = 4.0  # clarity of a picture with sound in it; silence has 1.6 to 3
_MISFIT = 1.3  # of the frames, by their noise, from which on it is a doubt


class HeatInversion:
    """The linear map from |p|^2 in a plane to the frames of a camera, and its inverse."""

    def __init__(
        self,
        registration: Registration,
        shape: tuple[int, int],
        counts: tuple[int, int],
        wavelength: float,
        screen: Screen | None = None,
        blur: float = 0.5,
    ) -> None:
        """Set up the cosines in the pixels; takes about 0.1 s.

        Args:
            registration: where the plane is in an image.
            shape: of an image (H, W).
            counts: cells (Nu, Nv) of the pictures.
            wavelength: of the sound in air [m].
            screen: the screen; None for the default one.
            blur: of the camera [pixels], standard deviation, without the area of a pixel.

        Raises:
            ValueError: an argument is out of range, or an image shows nothing of the plane.
        """
        require_kind("registration", registration, Registration)
        self.registration, self.screen = registration, Screen() if screen is None else screen
        require_kind("screen", self.screen, Screen)
        self.shape = positive_integers("shape", shape, 2)
        self.counts = positive_integers("counts", counts, 2)
        self._wavelength = positive("wavelength", wavelength, "m")
        spread = math.hypot(not_negative("blur", blur, "pixels"), 12**-0.5)
        self._cosines = Cosines(registration, self.shape, self._wavelength, spread)

    def picture(
        self,
        times: ArrayLike,
        images: ArrayLike,
        duration: float,
        *,
        latency: float | None = None,
        saturation: float | None = None,
        drift: float = _DRIFT,
        remaining: float = 0.0,
    ) -> Picture:
        """Return the picture of a sound that begins at time 0.

        Args:
            times: of the frames (T,) [s], some before 0; those after the sound help, too.
            images: (T, H, W) [degC or K]; NaN where a pixel says nothing.
            duration: of the sound [s], > 0.
            latency: time after which the frames show the screen [s]; None to find it in them.
            saturation: temperature from which on a pixel says nothing; None for no limit.
            drift: of all pixels together [K/s], standard deviation.
            remaining: heat of earlier sounds at time 0 [K], standard deviation.

        Raises:
            ValueError: shapes that do not fit, too few frames, or none before or after 0.
        """
        moments, values = self._checked(times, images, saturation)
        duration = positive("duration", duration, "s")
        settings = duration, not_negative("drift", drift, "K/s"), not_negative("remaining", remaining, "K")
        shift = 0.0 if latency is None else finite_number("latency", latency, "s")
        if not moments.min() <= shift < moments.max():
            raise invalid("latency", latency, f"must be in {moments.min():g} to {moments.max():g}", "s")
        fit = PulseFit(self._cosines, self.screen, moments - shift, values, *settings)
        doubts, uncertainty = [], 0.0
        seen = fit.latency() if latency is None else (shift, 0.0)
        if latency is None and seen is not None:
            shift, uncertainty = seen
            fit = PulseFit(self._cosines, self.screen, moments - shift, values, *settings)
        square = self._cosines.on_plane(fit.solve(), self.counts)
        if (misfit := fit.misfit()) > _MISFIT:
            doubts.append(f"the frames differ from a heated screen by {misfit:.3g} times their noise")
        variance, density = fit.variance(self.counts, _SMOOTH * self._wavelength)
        if unseen := float(np.mean(density < _UNSEEN * np.median(density))):
            doubts.append(f"{100 * unseen:.2g} % of the plane is not seen")
        of_square = np.hypot(max(1.0, misfit) * np.sqrt(variance), uncertainty * square)
        pressure = torch.from_numpy(np.sqrt(np.maximum(square, 0.0)))
        deviation = deviation_by_square(pressure, torch.from_numpy(of_square))
        if seen is None and clarity(pressure, deviation) > _SOUND:
            doubts.append("the latency of the frames is not seen, and taken as 0 s")
        return Picture(
            self.registration.plane,
            pressure,
            deviation,
            self.screen.heating is None,
            fit.frames,
            shift,
            tuple(doubts),
        )

    def fitted_screen(
        self, times: ArrayLike, images: ArrayLike, duration: float, saturation: float | None = None
    ) -> Screen:
        """Return the screen with the diffusivity and the loss time that fit the frames; takes seconds.

        Args:
            times: of the frames (T,) [s]; the last ones a loss time or more after the sound.
            images: of strong foci (T, H, W) [degC or K]; NaN where a pixel says nothing.
            duration: of the sound [s], > 0.
            saturation: temperature from which on a pixel says nothing; None for no limit.

        Raises:
            ValueError: as for `picture`.
        """
        moments, values = self._checked(times, images, saturation)
        duration = positive("duration", duration, "s")

        def screen_of(unknowns: Array) -> Screen:
            diffusivity, loss_time = np.exp(unknowns[:2])
            return replace(self.screen, diffusivity=float(diffusivity), loss_time=float(loss_time))

        def residuals(unknowns: Array) -> Array:
            late = moments - _LATE * unknowns[2]
            fit = PulseFit(self._cosines, screen_of(unknowns), late, values, duration, _DRIFT, 0.0)
            fit.solve()
            return fit.residuals().ravel() / first.noise

        first = PulseFit(self._cosines, self.screen, moments, values, duration, _DRIFT, 0.0)
        if (seen := first.latency()) is None:
            raise invalid("images", "no pulse in the noise", "must show one of strong foci")
        logarithms = math.log(self.screen.diffusivity), math.log(self.screen.loss_time)
        start = np.array([*logarithms, seen[0] / _LATE])
        steps = {"diff_step": 0.01, "x_scale": 0.1, "xtol": 1e-2, "ftol": 1e-5}
        bounds = start - _FARTHEST, start + _FARTHEST
        return screen_of(least_squares(residuals, start, bounds=bounds, **steps).x)

    def _checked(self, times: ArrayLike, images: ArrayLike, saturation: float | None) -> tuple[Array, Array]:
        """Return times (T,) and the values (T, N) of the pixels around the plane, NaN without one."""
        moments: Array = real_tensor("times", times, "s").detach().cpu().numpy()
        frames: Array = gappy_tensor("images", images).detach().cpu().numpy()
        if moments.ndim != 1 or frames.shape != (len(moments), *self.shape):
            accepted = f"must be {('T', *self.shape)}, and times (T,)"
            raise ValueError(f"images: shape {frames.shape}, times: shape {moments.shape}; {accepted}")
        if not moments.min(initial=math.inf) <= 0 < moments.max(initial=-math.inf):
            raise invalid("times", moments, "must have frames before and after 0, when the sound begins", "s")
        values = frames.reshape(len(moments), -1)[:, self._cosines.pixels]
        if saturation is not None:
            values = np.where(values < finite_number("saturation", saturation), values, np.nan)
        return moments, values
