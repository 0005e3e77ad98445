"""Unmodified cflib behind the relay: unharmed, all is as without it; harmed, cflib fails as we found it to."""

import contextlib
import threading
import time

import pytest

pytest.importorskip("cflib.crtp")
from cflib import crtp
from cflib.crazyflie import Crazyflie
from cflib.crazyflie.log import LogConfig
from cflib.crazyflie.syncCrazyflie import SyncCrazyflie
from relayed import down, now_on, relayed

from crazyem.links.connection import shut
from crazyem.links.crazyflie import CrazyflieLink

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")


@pytest.fixture(autouse=True)
def drivers():
    if not crtp.CLASSES:
        crtp.init_drivers()


def logs(cf, count=25):
    """Whether so many packets of one block come."""
    config, stamps = LogConfig("x", 10), []
    config.add_variable("pm.vbat")
    cf.log.add_config(config)
    config.data_received_cb.add_callback(lambda stamp, data, block: stamps.append(stamp))
    config.start()
    deadline = time.monotonic() + 60.0
    while len(stamps) < count and time.monotonic() < deadline:
        time.sleep(0.01)
    config.stop()
    return len(stamps) >= count


def test_cflib_connects_logs_and_writes_through_the_relay(resting):
    with relayed(resting.uri) as relay:
        with SyncCrazyflie(relay.uri, cf=Crazyflie(ro_cache=None, rw_cache=None)) as scf:
            scf.wait_for_params()
            assert logs(scf.cf)
            scf.cf.param.set_value("ctrlLee.mass", 0.0313)
            deadline = time.monotonic() + 60.0
            while not scf.cf.param.get_value("ctrlLee.mass").startswith("0.0313") and time.monotonic() < deadline:
                time.sleep(0.02)
            assert scf.cf.param.get_value("ctrlLee.mass").startswith("0.0313")
            scf.cf.link_statistics.stop()  # its ping thread fails if it sends while the link is closed
        for way in ("up", "down"):
            fates = relay.engine.counts.fates[way]
            assert fates["received"] == fates["forwarded"] > 500


def test_a_bad_air_costs_cflib_log_packets_only(resting):
    """Requests and replies pass; a third of the log data does not, some of it comes twice, late or out of order."""
    with relayed(resting.uri) as relay, SyncCrazyflie(relay.uri, cf=Crazyflie(ro_cache=None, rw_cache=None)) as scf:
        scf.wait_for_params()
        data = {"kinds": ("log.data",)}
        now_on(relay, down("drop", rate=0.33, burst=3.0, **data), down("duplicate", rate=0.2, **data),
               down("reorder", rate=0.2, **data), down("delay", jitter_ms=30.0))  # fmt: skip
        assert logs(scf.cf)
        assert scf.cf.is_connected()
        scf.cf.link_statistics.stop()


@pytest.mark.parametrize("k", [0, 5])
def test_one_lost_reply_hangs_cflib_and_not_us(fake_peer, k):
    with relayed(fake_peer.uri, down("drop", skip=k, count=1)) as relay:
        cf, done = Crazyflie(ro_cache=None, rw_cache=None), threading.Event()
        cf.fully_connected.add_callback(lambda uri: done.set())
        cf.open_link(relay.uri)
        assert not done.wait(2.0)
        shut(cf)
        relay.engine.replace([down("drop", skip=k, count=1)])
        link = CrazyflieLink(relay.uri)
        link.connect(60.0)
        with contextlib.closing(link):
            assert link.parameters["ctrlLee.mass"] == "float"
        assert relay.engine.strikes[0][1] == 1
