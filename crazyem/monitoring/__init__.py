"""What changes in flight: running tests on the innovations of the estimator's own filter.

hypotheses.py says what may change, as data; columns.py turns that into rows of numbers, kernels.py carries the
signatures along the filter (Willsky and Jones 1976), threshold.py turns a rate of false alarms into a threshold,
detector.py decides, repetition.py finds signals that stick. Windows of 0.04 to 2.6 s give a likelihood ratio each.
Parameters of the estimator, drag and delays of the measurements are nuisances, integrated out by their uncertainty.
Slow errors of the onboard estimate are predicted and taken off (slow_error.py). What is left is nearly white, so the
scale of each statistic needs only a tight prior and the last minute.
"""
