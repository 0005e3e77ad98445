"""Detection of changes in flight, by running tests on the innovations of the estimator's filter.

hypotheses.py defines the possible changes as data. columns.py computes their effects in each step. kernels.py carries
the signatures along the filter (Willsky and Jones 1976). threshold.py computes a threshold from a rate of false alarms.
detector.py decides. repetition.py finds stuck signals. Windows of 0.04 to 2.6 s give one likelihood ratio each.
Parameters of the estimator, drag and delays of the measurements are nuisances, integrated out with their priors. Slow
errors of the onboard estimate are predicted and subtracted (slow_error.py). The rest is nearly white, so a narrow prior
and the last minute of flight are enough for the scale of each statistic.
"""
