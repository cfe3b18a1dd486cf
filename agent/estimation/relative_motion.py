"""Where one robot is in the body frame of another: steps of both, the inverse, and composition.

The state of j relative to i is x = (x, y, z, th) (..., 4), m and rad: place in the body frame of i (FLU), heading of j
less that of i. Over a step both move by their body velocities (vx, vy, vz, yaw rate) (De Silva, Mann, Gosine 2015,
eq. 5), here as one exact composition:

    p' = R(-w_i dt) (p + R(th) v_j dt - v_i dt),   z' = z + (vz_j - vz_i) dt,   th' = th + (w_j - w_i) dt

An error of the yaw rate w_i moves everything at a distance sideways, along l = (y, -x), and turns it at once; it is
most of the noise. A belief is either linearized, or its moments are matched: a Gaussian heading of variance v turns a
vector d into E[R(th) d] = exp(-v/2) R(m) d, E cos 2th = exp(-2 v) cos 2m, and covariances with the state follow from
expected gradients (Stein's lemma), so that mean and covariance are exact however wide the heading is.

Places are complex numbers in here, p = x + i y. All arrays broadcast over leading axes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from agent.estimation.gaussian import wrap

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]


def stepped(
    mean: Array, cov: Array, own: Array, own_cov: Array, peer: Array, peer_cov: Array, dt: float, matched: bool
) -> tuple[Array, Array]:
    """Belief (..., 4), (..., 4, 4) of the peer dt [s] later.

    own, peer (..., 4) and their covariances (..., 4, 4) are the velocities of i and j as measured, each in its body
    frame. matched: exact moments; else linearized at the mean.
    """
    width = cov[..., 3, 3]
    shrink = np.exp(-0.5 * width) if matched else np.ones_like(width)
    facing = np.exp(1j * mean[..., 3])
    back = np.exp(-1j * dt * own[..., 3])
    along = dt * _place(peer)
    step = along * facing * shrink
    place = back * (_place(mean) + step - dt * _place(own))
    slope = 1j * back * step
    moved = np.empty(np.broadcast_shapes(mean.shape, own.shape, peer.shape))
    moved[..., 0], moved[..., 1] = place.real, place.imag
    moved[..., 2] = mean[..., 2] + dt * (peer[..., 2] - own[..., 2])
    moved[..., 3] = wrap(mean[..., 3] + dt * (peer[..., 3] - own[..., 3]))

    F = _turning(back, moved.shape)
    F[..., 0, 3], F[..., 1, 3] = slope.real, slope.imag
    new = F @ cov @ F.swapaxes(-1, -2)
    G = -dt * _turning(back, moved.shape)
    G[..., 0, 3], G[..., 1, 3] = dt * moved[..., 1], -dt * moved[..., 0]
    # Of a doubtful place a turn makes more doubt, in what the product of both errors adds.
    lever = dt * dt * own_cov[..., 3, 3] if matched else np.zeros(())
    plane = new[..., :2, :2].copy()
    new += G @ own_cov @ G.swapaxes(-1, -2)
    new[..., 0, 0] += lever * plane[..., 1, 1]
    new[..., 1, 1] += lever * plane[..., 0, 0]
    new[..., 0, 1] -= lever * plane[..., 0, 1]
    new[..., 1, 0] -= lever * plane[..., 1, 0]

    spread, pseudo = _noise_of(peer_cov)
    double = (back * facing) ** 2 * shrink**4
    spread, pseudo = dt * dt * spread, dt * dt * pseudo * double
    if matched:
        # What the turned step spreads beyond the part that is linear in the heading.
        spread = spread + np.abs(along) ** 2 - np.abs(step) ** 2 * (1.0 + width)
        pseudo = pseudo + along**2 * double - (back * step) ** 2 * (1.0 - width)
    _add_plane(new, spread, pseudo)
    body = dt * dt * back * facing * shrink
    for row in (2, 3):
        across = body * (peer_cov[..., 0, row] + 1j * peer_cov[..., 1, row])
        _add_across(new, row, across)
        for column in (2, 3):
            new[..., row, column] += dt * dt * peer_cov[..., row, column]
    return moved, _symmetric(new)


def inverted(mean: Array, cov: Array, matched: bool) -> tuple[Array, Array]:
    """Belief of i relative to j, from that of j relative to i (eq. 9)."""
    width = cov[..., 3, 3]
    shrink = np.exp(-0.5 * width) if matched else np.ones_like(width)
    facing = np.exp(-1j * mean[..., 3])
    p = _place(mean)
    lean = -(cov[..., 0, 3] + 1j * cov[..., 1, 3])
    turn = facing * shrink
    first = (p + 1j * lean) * turn if matched else p * turn
    found = np.stack([-first.real, -first.imag, -mean[..., 2], wrap(-mean[..., 3])], axis=-1)
    J = -_turning(turn, mean.shape)
    slope = 1j * first
    J[..., 0, 3], J[..., 1, 3] = slope.real, slope.imag
    new = J @ cov @ J.swapaxes(-1, -2)
    if matched:
        spread, pseudo = _noise_of(cov)
        across = turn * lean * 1j * first
        second = ((p + 2j * lean) ** 2 + pseudo) * (facing * shrink**2) ** 2
        cross = turn * lean * np.conj(1j * first)
        linear = shrink**2 * spread + width * np.abs(first) ** 2 + 2.0 * cross.real
        pseudo_linear = turn**2 * pseudo - width * first**2 + 2.0 * across
        _add_plane(
            new,
            np.abs(p) ** 2 + spread - np.abs(first) ** 2 - linear,
            second - first**2 - pseudo_linear,
        )
    return found, _symmetric(new)


def composed(mean_a: Array, cov_a: Array, mean_b: Array, cov_b: Array, matched: bool) -> tuple[Array, Array]:
    """Belief of j relative to i, from a of l relative to i and b of j relative to l, which are independent (eq. 11)."""
    width = cov_a[..., 3, 3]
    shrink = np.exp(-0.5 * width) if matched else np.ones_like(width)
    facing = np.exp(1j * mean_a[..., 3])
    p, turn = _place(mean_b), facing * shrink
    first = p * turn
    shape = np.broadcast_shapes(mean_a.shape, mean_b.shape)
    found = np.empty(shape)
    found[..., 0], found[..., 1] = mean_a[..., 0] + first.real, mean_a[..., 1] + first.imag
    found[..., 2] = mean_a[..., 2] + mean_b[..., 2]
    found[..., 3] = wrap(mean_a[..., 3] + mean_b[..., 3])
    Ja = np.broadcast_to(np.eye(4), (*shape, 4)).copy()
    slope = 1j * first
    Ja[..., 0, 3], Ja[..., 1, 3] = slope.real, slope.imag
    Jb = _turning(turn, shape)
    new = Ja @ cov_a @ Ja.swapaxes(-1, -2) + Jb @ cov_b @ Jb.swapaxes(-1, -2)
    if matched:
        spread, pseudo = _noise_of(cov_b)
        _add_plane(
            new,
            np.abs(p) ** 2 + spread - np.abs(first) ** 2 * (1.0 + width) - shrink**2 * spread,
            (p**2 + pseudo) * (facing * shrink**2) ** 2 - first**2 * (1.0 - width) - turn**2 * pseudo,
        )
    return found, _symmetric(new)


def _place(vector: Array) -> Complex:
    return np.asarray(vector[..., 0] + 1j * vector[..., 1])


def _noise_of(cov: Array) -> tuple[Array, Complex]:
    """E |z|^2 and E z^2 of the error z = x + i y."""
    return (
        np.asarray(cov[..., 0, 0] + cov[..., 1, 1]),
        np.asarray(cov[..., 0, 0] - cov[..., 1, 1] + 2j * cov[..., 0, 1]),
    )


def _turning(turn: Complex, shape: tuple[int, ...]) -> Array:
    """(..., 4, 4) that multiplies x + i y with a complex number and keeps z and th."""
    found = np.zeros((*shape, 4))
    found[..., 0, 0] = found[..., 1, 1] = turn.real
    found[..., 1, 0] = turn.imag
    found[..., 0, 1] = -turn.imag
    found[..., 2, 2] = found[..., 3, 3] = 1.0
    return found


def _add_plane(cov: Array, spread: Array, pseudo: Complex) -> None:
    """Adds an independent error of x and y, of E |z|^2 and E z^2."""
    cov[..., 0, 0] += 0.5 * (spread + pseudo.real)
    cov[..., 1, 1] += 0.5 * (spread - pseudo.real)
    cov[..., 0, 1] += 0.5 * pseudo.imag
    cov[..., 1, 0] += 0.5 * pseudo.imag


def _add_across(cov: Array, row: int, across: Complex) -> None:
    cov[..., 0, row] += across.real
    cov[..., row, 0] += across.real
    cov[..., 1, row] += across.imag
    cov[..., row, 1] += across.imag


def _symmetric(matrix: Array) -> Array:
    return np.asarray(0.5 * (matrix + matrix.swapaxes(-1, -2)))
