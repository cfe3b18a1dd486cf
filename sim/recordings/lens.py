"""What a real lens makes of a point, taken back: distorted pixels become those of an ideal pinhole camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agent.estimation.observation import Intrinsics

Array = NDArray[np.float64]

ITERATIONS = 100
CONVERGED = 1e-9
"""Largest step of the iteration, on the plane at unit distance, at which a point counts as found."""


@dataclass(frozen=True, slots=True)
class Lens:
    """Focal lengths and principal point [px] of a sensor, its size [px], and the distortion k1, k2, p1, p2, k3.

    Radial and tangential distortion as of Brown (1966); pixels need not be square.
    """

    focal_px: tuple[float, float]
    center_px: tuple[float, float]
    size_px: tuple[float, float]
    distortion: tuple[float, float, float, float, float]

    def ideal(self) -> Intrinsics:
        """The pinhole camera whose pixels `undistorted` tells: square ones, as high as those of the sensor."""
        (fx, fy), (cx, cy), (width, height) = self.focal_px, self.center_px, self.size_px
        return Intrinsics(fy, (cx * fy / fx, cy), (width * fy / fx, height))

    def undistorted(self, pixels: Array) -> Array:
        """Pixels (K, 2) of the ideal camera for pixels (K, 2) of this one; NaN where no point is seen there."""
        ideal = self.ideal()
        return np.asarray(ideal.focal_px * self.plane(pixels) + np.array(ideal.center_px))

    def plane(self, pixels: Array) -> Array:
        """Where (K, 2) rays of pixels (K, 2) meet the plane at unit distance, right and down; NaN where nowhere.

        A fixed-point iteration of the distortion: it converges as long as that is mild within the image.
        """
        seen = (pixels - np.array(self.center_px)) / np.array(self.focal_px)
        found, step = seen, np.full(len(seen), np.inf)
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            for _ in range(ITERATIONS):
                radial, shift = self._distortion(found)
                nearer = (seen - shift) / radial[:, None]
                step, found = np.max(np.abs(nearer - found), axis=1, initial=0.0), nearer
                if not np.any(step > 0.1 * CONVERGED):
                    break
        return np.where((step <= CONVERGED)[:, None], found, np.nan)

    def distorted(self, plane: Array) -> Array:
        """Pixels (K, 2) of points (K, 2) on the plane at unit distance."""
        radial, shift = self._distortion(plane)
        return np.asarray((plane * radial[:, None] + shift) * np.array(self.focal_px) + np.array(self.center_px))

    def _distortion(self, plane: Array) -> tuple[Array, Array]:
        """Factor (K,) and shift (K, 2) of points (K, 2) on the plane at unit distance."""
        k1, k2, p1, p2, k3 = self.distortion
        x, y = plane[:, 0], plane[:, 1]
        square = x**2 + y**2
        radial = 1.0 + square * (k1 + square * (k2 + square * k3))
        across = 2.0 * p1 * x * y + p2 * (square + 2.0 * x**2)
        along = p1 * (square + 2.0 * y**2) + 2.0 * p2 * x * y
        return radial, np.stack([across, along], axis=-1)
