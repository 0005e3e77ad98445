"""What holds for all tests: no example fails for its wall-clock time, which a busy machine makes any."""

from hypothesis import HealthCheck, settings

settings.register_profile("any machine", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("any machine")
