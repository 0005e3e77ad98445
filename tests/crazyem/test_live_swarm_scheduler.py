"""Several drones on one computer: the scheduler that estimates for all, and updates that are left out."""

import threading
import time

import pytest
import synthetic
from fake_drone import until

from crazyem.estimation.online import OnlineEstimator
from crazyem.live.scheduler import LONGEST_DEFERRAL, TIME_SLICE, Mailbox, Scheduler, UpdateThrottle
from crazyem.signals.sample import Sample
from crazyem.vehicle import Vehicle


# the scheduler
@pytest.fixture
def scheduler():
    one = Scheduler(3)
    yield one
    one.close()


def test_items_of_a_mailbox_are_worked_off_in_order_and_one_at_a_time(scheduler):
    done = {i: [] for i in range(20)}
    inside = dict.fromkeys(done, 0)
    worst = []

    def worker(i):
        def work(item):
            inside[i] += 1
            worst.append(inside[i])
            done[i].append(item)
            if item % 50 == 0:
                time.sleep(0.001)
            inside[i] -= 1

        return work

    boxes = {i: Mailbox(scheduler, worker(i), lambda e: None) for i in done}
    for item in range(200):
        for box in boxes.values():
            box.put(item)
    assert all(box.wait(60.0) for box in boxes.values())
    assert all(items == list(range(200)) for items in done.values())
    assert max(worst) == 1


def test_one_thread_takes_in_for_all_until_it_is_told_not_to(scheduler):
    calls = {"a": [], "b": []}
    sources = {k: lambda k=k: bool(calls[k].append(threading.current_thread().name)) for k in calls}
    for source in sources.values():
        scheduler.poller.add(source)
    until(lambda: min(map(len, calls.values())) > 5)
    scheduler.poller.remove(sources["a"])
    count = len(calls["a"])
    after = len(calls["b"])
    until(lambda: len(calls["b"]) > after + 5)
    assert len(calls["a"]) == count
    assert set(calls["a"] + calls["b"]) == {"crazyem-receive"}


def test_a_mailbox_that_fails_ends_alone(scheduler):
    errors, done = [], []

    def fails(item):
        raise ValueError(f"item {item}")

    bad, good = Mailbox(scheduler, fails, errors.append), Mailbox(scheduler, done.append, errors.append)
    for item in range(3):
        bad.put(item)
        good.put(item)
    assert bad.wait(60.0)
    assert good.wait(60.0)
    bad.put(4)
    assert [str(e) for e in errors] == ["item 0"]
    assert done == [0, 1, 2]


def test_a_busy_drone_does_not_starve_the_others():
    one = Scheduler(1)
    asked, done = threading.Event(), []

    def work(item):
        asked.wait(60.0)
        time.sleep(TIME_SLICE / 2)
        done.append(item)

    slow = Mailbox(one, work, lambda e: None)
    quick = Mailbox(one, done.append, lambda e: None)
    for item in range(30):
        slow.put(item)
    quick.put("now")
    asked.set()
    assert quick.wait(60.0)
    assert slow.wait(60.0)
    assert done.index("now") < 5
    one.close()


class Counting:
    """An estimator that makes an update every `every` samples of position."""

    def __init__(self, every=4):
        self.every, self.since, self.fed, self.updates = every, 0, 0, []
        self.refresh = 12

    def share_computer(self, refresh):
        self.refresh = refresh
        self.airborne, self.update_seconds = True, []

    def feed(self, sample):
        self.fed += 1
        if sample.signal != "position":
            return None
        self.since += 1
        if self.since < self.every:
            return None
        self.updates.append((sample.time, self.since))
        self.since = 0
        return object()

    def finish(self):
        return self.every


def run_throttled(lags, **options):
    inner = Counting()
    throttle = UpdateThrottle(inner, **options)
    for k, lag in enumerate(lags):
        t = 0.01 * k
        throttle.newest = lambda t=t, lag=lag: t + lag
        for signal in ("position", "velocity", "attitude"):
            throttle.feed(Sample(signal, t, (0.0,)))
    return inner, throttle


def test_on_time_nothing_is_left_out():
    inner, throttle = run_throttled([0.0] * 400)
    assert [n for _, n in inner.updates] == [4] * 100
    assert (throttle.skipped, throttle.finish()) == (0, 4)


def test_late_updates_are_left_out_and_samples_are_not():
    inner, throttle = run_throttled([0.0] * 100 + [0.2] * 50 + [0.0] * 50)
    assert inner.fed == 3 * 200
    late = [t for t, _ in inner.updates if 1.0 <= t < 1.5]
    assert late == []
    assert sum(n for _, n in inner.updates) + inner.since == 200  # every sample is in an update, or waits for one
    assert throttle.skipped == 12
    assert throttle.behind == 0.0


def test_however_late_an_update_a_second_is_made():
    inner, throttle = run_throttled([5.0] * 1000)
    assert all(b - a <= LONGEST_DEFERRAL + 0.05 for (a, _), (b, _) in zip(inner.updates, inner.updates[1:]))
    assert len(inner.updates) == pytest.approx(10.0 / LONGEST_DEFERRAL, abs=1)
    assert throttle.behind == pytest.approx(5.0)


@pytest.mark.parametrize(("drones", "refresh"), [(25, 100), (3, 12)])
def test_updates_of_several_drones_are_out_of_step(drones, refresh):
    """The costly passes come every `refresh` updates, evenly spread; for few drones as often as for one."""
    inner = [run_throttled([0.0] * 500, number=i, of=drones)[0] for i in range(drones)]
    assert [i.updates[0][1] for i in inner] == [4 + 16 * k for k in range(drones)]
    assert all(n == 4 for i in inner for _, n in i.updates[1:])
    assert all(i.refresh == refresh for i in inner)


def test_a_throttled_estimator_on_time_is_the_estimator_bit_for_bit_and_a_late_one_close_to_it():
    vehicle = Vehicle(name="v", mass=0.036, inertia=(2.0e-5, 2.1e-5, 3.6e-5), motor_time_constant=0.06)
    samples = synthetic.samples(synthetic.fly(duration=2.0))
    plain, on_time, late = (OnlineEstimator(vehicle, window=60) for _ in range(3))
    throttle = [UpdateThrottle(on_time), UpdateThrottle(late)]
    at = [0.0]
    throttle[0].newest = lambda: at[0]
    # behind for the first half of every second
    throttle[1].newest = lambda: at[0] + (0.3 if at[0] % 1.0 < 0.5 else 0.0)
    for sample in samples:
        at[0] = sample.time
        expected = plain.feed(sample)
        assert throttle[0].feed(sample) == expected
        throttle[1].feed(sample)
    final = plain.finish()
    assert throttle[0].finish() == final
    assert throttle[0].skipped == 0
    assert throttle[1].skipped > 10
    other = throttle[1].finish()
    assert late.counters.nodes == plain.counters.nodes  # not one sample is missing
    for name in ("mass", "Ixx", "Iyy", "Izz"):
        assert abs(other[name].value - final[name].value) < 0.1 * final[name].sd
