"""Made-up examples: few and always the same in `make test`, many and new ones in `make slow`.

No example fails for its wall-clock time, which a busy machine makes any.

Ctrl-C reaches the programs that tests start even where a shell has started the tests in the background, deaf to it.
"""

import signal

from hypothesis import HealthCheck, settings

signal.signal(signal.SIGINT, signal.default_int_handler)

settings.register_profile(
    "steady", derandomize=True, database=None, max_examples=15, deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
)  # fmt: skip
settings.register_profile("deep", settings.get_profile("steady"), derandomize=False, max_examples=30, print_blob=True)
settings.load_profile("steady")  # --hypothesis-profile deep loads the other


def pytest_collection_modifyitems(items: list) -> None:
    """Flights in real time begin first: they take minutes, and hardly any processor time."""
    items.sort(key=lambda item: "test_live_first_flight" not in item.nodeid)
