"""Made-up examples: few in `make test`, many in `make slow-fixed`, always the same; many and new in `make slow`.

No example fails for its wall-clock time, which a busy machine makes any.

Ctrl-C reaches the programs that tests start even where a shell has started the tests in the background, deaf to it.
"""

import gc
import signal

from hypothesis import HealthCheck, settings

signal.signal(signal.SIGINT, signal.default_int_handler)

settings.register_profile(
    "steady", derandomize=True, database=None, max_examples=15, deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
)  # fmt: skip
settings.register_profile("many", settings.get_profile("steady"), max_examples=30)
settings.register_profile("new", settings.get_profile("many"), derandomize=False, print_blob=True)
settings.load_profile("steady")  # --hypothesis-profile loads the others


def pytest_collection_modifyitems(items: list) -> None:
    """The longest test begins first: at the end of a list it would keep the others waiting for a minute."""
    items.sort(key=lambda item: "test_the_first_flight_after_installation" not in item.nodeid)


def pytest_collection_finish() -> None:
    """What was imported and collected stays: the garbage collector need not look through it again and again."""
    gc.collect()
    gc.freeze()
