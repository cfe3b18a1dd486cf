"""Assertions in the terms of the domain, shared by the tests."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

Array = NDArray[np.float64]


def anees_band(samples: int, dof: int, confidence: float = 0.999) -> tuple[float, float]:
    """Where the mean of `samples` independent NEES per degree of freedom of an honest filter lies.

    The sum of N values of e' P^-1 e is chi-square with N dof degrees of freedom (Bar-Shalom, Li, Kirubarajan 2001,
    section 5.4.2).
    """
    tail = (1.0 - confidence) / 2.0
    low, high = chi2.ppf([tail, 1.0 - tail], samples * dof) / (samples * dof)
    return float(low), float(high)


def assert_consistent(
    nees_samples: Array, dof: int, *, independent: int | None = None, confidence: float = 0.999, slack: float = 1.0
) -> None:
    """The NEES per degree of freedom (T,) of a filter whose errors are as large as it claims, neither more nor less.

    independent   how many of the samples count as independent (None: all of them); samples of one trial that follow
                  each other closely repeat each other, so give the number of trials
    slack         factor by which linearization may widen the band on both sides
    """
    samples = np.asarray(nees_samples, dtype=np.float64)
    assert samples.size, "no NEES samples"
    assert np.all(np.isfinite(samples)), "a NEES sample is not finite"
    low, high = anees_band(independent if independent is not None else samples.size, dof, confidence)
    mean = float(samples.mean())
    assert mean <= high * slack, f"overconfident: ANEES {mean:.3f} is above {high * slack:.3f}"
    assert mean >= low / slack, f"underconfident: ANEES {mean:.3f} is below {low / slack:.3f}"


def assert_covariance(cov: Array) -> None:
    """Matrices (..., n, n) are finite, symmetric to rounding and positive definite."""
    matrices = np.asarray(cov, dtype=np.float64)
    assert np.all(np.isfinite(matrices)), "a covariance is not finite"
    scale = np.abs(matrices).max(axis=(-2, -1), keepdims=True)
    assert np.all(np.abs(matrices - matrices.swapaxes(-1, -2)) <= 1e-9 * scale), "a covariance is not symmetric"
    smallest = float(np.linalg.eigvalsh(matrices).min())
    assert smallest > 0.0, f"a covariance has the eigenvalue {smallest:.3g}"
