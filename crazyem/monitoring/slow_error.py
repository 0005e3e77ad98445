"""Model of innovations that are not white: white noise plus a slow error of first order.

The log contains the state estimate of an onboard filter. Errors of its velocities and attitudes last for seconds, so
the innovations of the estimator are correlated. A slow error of variance s^2 that decays by phi per sample, in white
noise of variance r^2, has the covariance s^2 phi^n at lag n. A near and a far lag give s^2 and phi. A steady Kalman
filter predicts the slow error.
"""

import numpy as np
from numpy.typing import NDArray

NEAR, FAR = (2, 3, 4, 5), (17, 19, 21, 23)  # lags [samples]: after other short correlation; during the decay
LAGS = np.array(NEAR + FAR)
LEAST, MOST = 0.01, 0.999  # least ratio of far to near covariance; largest decay, and share of the variance


def slow_error(moments: NDArray[np.float64]) -> NDArray[np.float64]:
    """Decay per sample, gain, 1 over sd of the rest, (3, 12), from covariances (9, 12) at lag 0 and LAGS.

    With an innovation v, the filter updates its prediction by m <- phi (m + gain (v - m)); the rest is v - m. Its
    standard deviation is at least that of the estimator, because slow errors grow tenfold from hover to manoeuvres.
    """
    whole, near, far = moments[0], np.maximum(moments[1:5].mean(0), 1e-12), moments[5:].mean(0)
    phi = np.minimum(np.clip(far / near, LEAST, 1.0) ** (1.0 / (np.mean(FAR) - np.mean(NEAR))), MOST)
    slow = np.minimum(near / phi ** np.mean(NEAR), MOST * whole)
    white, driven = whole - slow, slow * (1.0 - phi**2)
    half = 0.5 * (driven - white * (1.0 - phi**2))
    predicted = half + np.sqrt(half**2 + driven * white)  # variance of the slow error before a sample
    left = predicted + white
    return np.stack([phi, predicted / left, np.maximum(left, 1.0) ** -0.5])
