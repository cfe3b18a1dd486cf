"""Mean and covariance of a pose moved in its own frame, exact for a Gaussian belief however wide its heading is.

A body increment u = dx + i dy moves a position by u g e^(i phi), with g = 1 and phi the heading, or with a gain g and a
heading phi that leans on a gain of turning. For jointly Gaussian g and phi the characteristic function gives
(C = cov(g, phi), V = var(g), s^2 = var(phi), means g0, phi0)

    E[g e^(i phi)]      = (g0 + i C) e^(i phi0 - s^2/2)
    E[g^2 e^(2 i phi)]  = ((g0 + 2 i C)^2 + V) e^(2 i phi0 - 2 s^2)
    E[g^2]              = g0^2 + V

and the covariance with the state is P times the expected gradient (Stein's lemma), which makes F the statistical
linearization. This is what an unscented prediction (UT-CLAT eq. 9-12) approximates. Sigma points of a heading that is
wider than about a radian lie turns apart and alias: covariances of the position shrink that should grow.

What is not linear in the state, the spread of the step about its linear part, is no white noise: a heading that is off
stays off, and the next step leaves the same over. A Gaussian keeps no correlation for that. With a wide heading, where
it matters, the correlation of a step's spread L with the position error of covariance P is taken for unknown:
(1 + 1/r) L + (1 + r) P bounds their sum whatever it is, and r^2 = tr L / tr P adds the deviations up. Otherwise a robot
that heads anywhere would seem to stay where it is.
"""

from __future__ import annotations

import cmath
import math

import numpy as np
from numpy.typing import NDArray

from agent.estimation.gaussian import congruence, identity, symmetrize, wrap_scalar
from agent.estimation.unscented import Propagated

Array = NDArray[np.float64]


def moved_in_its_frame(
    mean: Array,
    cov: Array,
    delta: Array,
    noise: Array,
    heading: int,
    gains: tuple[int, int] | None = None,
    persistent_rad2: float = math.inf,
) -> Propagated:
    """Belief (n,), (n, n) of a state x, y, ... after a body increment, with noise in the body frame at its beginning.

    delta (k,) and noise (k, k) are of the increment's dx, dy, [dz,] dyaw, dz being of the third component unless that
    is the heading. `heading` says where the heading sits, `gains` the gains of forward motion and of turning: the chord
    then leans by half of what the turn is longer. The mean's heading is wrapped. `persistent_rad2`: variance of a
    heading from which on what steps leave over counts as correlated; infinite: the moments of this step alone.
    """
    n, steps = len(mean), delta.tolist()
    dyaw, u = steps[-1], complex(steps[0], steps[1])
    scale, V, C = 1.0, 0.0, 0.0
    facing, width = mean.item(heading), cov.item(heading, heading)
    phi, turned, s2 = facing, dyaw, width
    if gains is not None:
        along, turn = gains
        lean = np.zeros(n)
        lean[heading] = 1.0
        lean[turn] = 0.5 * dyaw
        phi += 0.5 * dyaw * (float(mean[turn]) - 1.0)
        scale, turned = float(mean[along]), dyaw * float(mean[turn])
        V, C, s2 = float(cov[along, along]), float(cov[along] @ lean), float(lean @ cov @ lean)
    direction = cmath.exp(1j * phi - 0.5 * s2)
    first = (scale + 1j * C) * direction

    moved, F = mean.copy(), identity(n).copy()
    step = u * first
    moved[0] += step.real
    moved[1] += step.imag
    moved[heading] = wrap_scalar(facing + turned)
    slope = 1j * step
    if gains is None:
        F[0, heading], F[1, heading] = slope.real, slope.imag
        linear, pseudo_linear = s2 * abs(slope) ** 2, s2 * slope**2
    else:
        gradient = slope * lean
        gradient[along] += u * direction
        F[heading, turn] = dyaw
        F[0] += gradient.real
        F[1] += gradient.imag
        weighted = cov @ gradient
        linear, pseudo_linear = float((gradient.conj() @ weighted).real), complex(gradient @ weighted)
    new = congruence(F, cov)
    # What the step's own spread has beyond its part that is linear in the state: E|z|^2 and E z^2 of a complex number.
    spread = abs(u) ** 2 * (scale**2 + V) - abs(step) ** 2 - linear
    pseudo = u**2 * ((scale + 2j * C) ** 2 + V) * cmath.exp(2j * phi - 2.0 * s2) - step**2 - pseudo_linear
    place = float(new[0, 0] + new[1, 1])
    if s2 > persistent_rad2 and place > 0.0 and spread > 0.0:
        ratio = math.sqrt(spread / place)
        new[:2, :2] *= 1.0 + ratio
        spread, pseudo = spread * (1.0 + 1.0 / ratio), pseudo * (1.0 + 1.0 / ratio)

    Q = noise.tolist()
    spread += Q[0][0] + Q[1][1]
    pseudo += (Q[0][0] - Q[1][1] + 2j * Q[0][1]) * cmath.exp(2j * facing - 2.0 * width)
    body = cmath.exp(1j * facing - 0.5 * width)
    added = np.zeros((n, n))
    added[0, 0], added[1, 1] = 0.5 * (spread + pseudo.real), 0.5 * (spread - pseudo.real)
    added[0, 1] = added[1, 0] = 0.5 * pseudo.imag
    spatial = len(steps) == 4 and heading > 2
    others = ((len(steps) - 1, heading),) if not spatial else ((2, 2), (3, heading))
    for row, other in others:
        across = body * complex(Q[0][row], Q[1][row])
        added[0, other] = added[other, 0] = across.real
        added[1, other] = added[other, 1] = across.imag
        for column, another in others:
            added[other, another] = Q[row][column]
    if spatial:
        moved[2] += steps[2]
    return Propagated(moved, symmetrize(new + added), F)
