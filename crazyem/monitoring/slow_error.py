"""Innovations that are not white: white noise, and a slow error of first order below it.

The log holds the estimate of a filter on board. Its velocities and attitudes err for seconds, so the innovations of the
estimator go on in one direction. A slow error of variance s^2 that decays by phi a sample, in white noise of variance
r^2, has the covariance s^2 phi^n at lag n: a near and a far one tell both. A Kalman filter in the steady state predicts
the slow error.
"""

import numpy as np
from numpy.typing import NDArray

NEAR, FAR = (2, 3, 4, 5), (17, 19, 21, 23)  # lags [samples]: beyond what is left of a step; while it decays
LAGS = np.array(NEAR + FAR)
LEAST, MOST = 0.01, 0.999  # of the covariance at the second lag over that at the first; of decay and share


def slow_error(moments: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3, 12) decay a sample, gain, 1 over the standard deviation of what is left, from covariances (9, 12) at 0, LAGS.

    Of an innovation v the filter keeps m <- phi (m + gain (v - m)); v - m is what is left. No signal is taken as surer
    than the estimator takes it: slow errors grow tenfold from hover to manoeuvres.
    """
    whole, near, far = moments[0], np.maximum(moments[1:5].mean(0), 1e-12), moments[5:].mean(0)
    phi = np.minimum(np.clip(far / near, LEAST, 1.0) ** (1.0 / (np.mean(FAR) - np.mean(NEAR))), MOST)
    slow = np.minimum(near / phi ** np.mean(NEAR), MOST * whole)
    white, driven = whole - slow, slow * (1.0 - phi**2)
    half = 0.5 * (driven - white * (1.0 - phi**2))
    predicted = half + np.sqrt(half**2 + driven * white)  # variance of the slow error before a sample
    left = predicted + white
    return np.stack([phi, predicted / left, np.maximum(left, 1.0) ** -0.5])
