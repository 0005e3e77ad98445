"""Made-up examples: few and always the same in `make test`, many and new in `make slow`.

No example fails for its wall-clock time, which a busy machine makes any.

Ctrl-C reaches the programs that tests start even where a shell has started the tests in the background, deaf to it.
"""

import gc
import re
import signal
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

signal.signal(signal.SIGINT, signal.default_int_handler)

settings.register_profile(
    "steady", derandomize=True, database=None, max_examples=15, deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
)  # fmt: skip
settings.register_profile(
    "new", settings.get_profile("steady"), max_examples=30, derandomize=False, print_blob=True
)  # fmt: skip
settings.load_profile("steady")  # --hypothesis-profile loads the others


# Tests of ten seconds and more, the longest first.
LONGEST = (
    "test_reply_lost_while_connecting", "test_a_payload_hung_under_in_flight_is_found_told_pushed_and_replayed",
    "test_mass_is_found_pushed_as_hover_thrust_and_replayed_bit_for_bit", "test_the_notebooks_run",
    "test_a_cut_propeller_is_named_with_what_it_lacks_also_where_rotors_are_relabelled",
    "test_deaf_for_three_seconds_in_flight", "test_a_serial_port_and_a_dry_run_that_writes_nothing",
    "test_drone_lost_in_flight_leaves_a_readable_recording", "test_healthy_flights_tell_a_smaller_cut",
    "test_flights_find_the_payload_and_fly_with_it", "test_intervals_cover_and_nothing_is_biased",
    "test_a_drone_whose_commands_shake_has_a_trim_first", "test_the_site_builds_with_strict_links",
)  # fmt: skip


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """A file none of whose tests would run is not imported: all of them long, or none of them."""
    if collection_path.suffix != ".py" or config.option.markexpr not in ("slow", "not slow"):
        return None
    text = collection_path.read_text(encoding="utf-8")
    if config.option.markexpr == "slow":
        return True if "mark.slow" not in text else None
    return True if re.search(r"^pytestmark = pytest\.mark\.slow\b", text, re.MULTILINE) else None


@pytest.hookimpl(trylast=True)  # after those that `-m` and `-k` leave out are gone
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """The longest tests begin first, each at the head of a process's part: at an end it would keep all others waiting.

    pytest-xdist gives each process an even part of the list, one after the other.
    """
    count = getattr(config, "workerinput", {}).get("workercount", 1)
    plain = {item: item.name.partition("[")[0] for item in items}
    long = [item for name in LONGEST for item in items if plain[item] == name]
    rest = [item for item in items if plain[item] not in LONGEST]
    order: list[pytest.Item] = []
    for part in range(count):
        heads = long[part::count]
        size = max(0, (len(items) - len(order)) // (count - part) - len(heads))
        order += heads + rest[:size]
        rest = rest[size:]
    items[:] = order + rest


def pytest_collection_finish() -> None:
    """What was imported and collected stays: the garbage collector need not look through it again and again."""
    gc.collect()
    gc.freeze()
