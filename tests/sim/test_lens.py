"""Lenses: distortion is taken off exactly, and what no ray makes is told."""

from __future__ import annotations

import numpy as np
import pytest

from sim.recordings.lens import Lens

WIDE = Lens((874.5, 894.1), (970.3, 531.3), (1920.0, 1080.0), (-0.26, 0.075, -1.4e-4, 1.7e-4, -0.009))
PHONE = Lens((1569.2, 1572.0), (956.6, 533.1), (1920.0, 1080.0), (0.189, -0.627, -1.4e-3, 3.9e-4, 0.606))
NARROW = Lens((1176.9, 1572.9), (702.7, 532.0), (1440.0, 1080.0), (-0.1, 0.14, -8.5e-5, -3.9e-4, -0.068))


@pytest.mark.parametrize(
    ("lens", "reach"), [(WIDE, 1.1), (PHONE, 0.72), (NARROW, 0.72)], ids=["wide", "phone", "narrow"]
)
def test_distortion_is_taken_off_in_the_whole_image(lens: Lens, reach: float) -> None:
    """But for the corners of the wide lens, which its polynomial does not reach: it turns back before them."""
    width, height = lens.size_px
    pixels = np.array([(x, y) for x in np.linspace(0.0, width, 25) for y in np.linspace(0.0, height, 15)])
    away = np.linalg.norm((pixels - lens.center_px) / np.array(lens.focal_px), axis=1)
    pixels = pixels[away <= reach]
    assert len(pixels) > 300
    np.testing.assert_allclose(lens.distorted(lens.plane(pixels)), pixels, atol=1e-5)


def test_a_lens_without_distortion_is_a_pinhole() -> None:
    lens = Lens((1000.0, 1000.0), (640.0, 360.0), (1280.0, 720.0), (0.0, 0.0, 0.0, 0.0, 0.0))
    np.testing.assert_allclose(lens.plane(np.array([[740.0, 160.0]])), [[0.1, -0.2]], atol=1e-12)
    np.testing.assert_allclose(lens.undistorted(np.array([[740.0, 160.0]])), [[740.0, 160.0]], atol=1e-9)


def test_ideal_pixels_are_square() -> None:
    lens = Lens((750.0, 1000.0), (600.0, 400.0), (1200.0, 800.0), (0.0, 0.0, 0.0, 0.0, 0.0))
    ideal = lens.ideal()
    assert (ideal.focal_px, ideal.center_px, ideal.size_px) == (1000.0, (800.0, 400.0), (1600.0, 800.0))
    np.testing.assert_allclose(lens.undistorted(np.array([[675.0, 300.0]])), [[900.0, 300.0]], atol=1e-9)


def test_distortion_is_that_of_the_formula() -> None:
    """x (1 + k1 r2 + k2 r4 + k3 r6) + 2 p1 x y + p2 (r2 + 2 x2), by hand at (0.5, 0.2), where r2 = 0.29."""
    lens = Lens((1.0, 1.0), (0.0, 0.0), (2.0, 2.0), (0.1, 0.2, 0.01, 0.03, 0.4))
    radial = 1.0 + 0.1 * 0.29 + 0.2 * 0.29**2 + 0.4 * 0.29**3
    across = 2.0 * 0.01 * 0.5 * 0.2 + 0.03 * (0.29 + 2.0 * 0.25)
    along = 0.01 * (0.29 + 2.0 * 0.04) + 2.0 * 0.03 * 0.5 * 0.2
    np.testing.assert_allclose(
        lens.distorted(np.array([[0.5, 0.2]])), [[0.5 * radial + across, 0.2 * radial + along]], rtol=1e-12
    )


def test_a_pixel_that_no_ray_makes_is_no_number() -> None:
    """A barrel whose rim turns back on itself: nothing is seen beyond 0.385 of the focal length."""
    lens = Lens((1000.0, 1000.0), (0.0, 0.0), (2000.0, 2000.0), (-1.0, 0.0, 0.0, 0.0, 0.0))
    found = lens.plane(np.array([[300.0, 0.0], [600.0, 0.0]]))
    assert found[0, 0] == pytest.approx(0.3389, abs=1e-4)
    assert np.isnan(found[1]).all()
