"""Persistent parameters: stored, read back, cleared and reformatted over reboots; a storage file that is none."""

import json
import struct

import pytest
from service_client import Client

from firmware_sim import contents
from firmware_sim.errors import ServerError
from firmware_sim.services.memory import Storage

STORE, STATE, CLEAR, DEFAULT = b"\x03", b"\x04", b"\x05", b"\x08"
NAME = "kalman.dragB_x"


def value_of(client: Client, name: str) -> float:
    return client.firmware.param.table.by_name[name].value


def write(client: Client, name: str, data: bytes) -> None:
    client.ask(2, 2, client.param_id(name) + data)


def stored(client: Client, name: str) -> bool:
    return client.ask(2, 3, STATE + client.param_id(name))[0][3] == 1


def test_a_stored_value_is_there_after_a_reboot_and_a_written_one_is_not(tmp_path):
    path = tmp_path / "storage.json"
    for storage in (Storage(), Storage(path)):
        first = Client(storage=storage)
        write(first, NAME, struct.pack("<f", 0.35))
        write(first, "kalman.dragB_y", struct.pack("<f", 0.2))
        assert first.ask(2, 3, STORE + first.param_id(NAME))[0][3] == 0
        second = Client(storage=storage, parameters={NAME: 0.1})  # what a client stored is newer than a boot value
        assert value_of(second, NAME) == pytest.approx(0.35)
        assert value_of(second, "kalman.dragB_y") == 0.0
        assert stored(second, NAME)
        assert second.ask(2, 3, DEFAULT + second.param_id(NAME))[0][3:] == b"\0" + struct.pack("<f", 0.0)
    assert json.loads(path.read_text()) == {NAME: pytest.approx(0.35)}
    third = Client(storage=Storage(path))
    assert value_of(third, NAME) == pytest.approx(0.35)
    third.ask(2, 3, CLEAR + third.param_id(NAME))
    assert not stored(third, NAME)
    assert value_of(third, NAME) == pytest.approx(0.35)  # until the next boot
    assert value_of(Client(storage=Storage(path)), NAME) == 0.0


def test_only_persistent_parameters_can_be_stored():
    client = Client()
    kept = [n for n, p in contents.PARAMETERS.items() if client.ask(2, 3, STORE + client.param_id(n))[0][3] == 0]
    assert kept == [n for n, p in contents.PARAMETERS.items() if "p" in p.flags]
    mass = client.param_id("ctrlLee.mass")  # not persistent: its state can be asked for, as of any other
    assert client.ask(2, 3, STATE + mass) == [STATE + mass + b"\0" + struct.pack("<f", 0.029)]
    selftest = client.param_id("system.selftestPassed")
    assert client.ask(2, 3, DEFAULT + selftest)[0][3:] == b"\x02"  # read-only: no default value


def test_reformatting_forgets_all():
    client = Client()
    client.ask(2, 3, STORE + client.param_id(NAME))
    assert stored(client, NAME)
    write(client, "system.storageReformat", b"\x01")
    assert not stored(client, NAME)
    assert value_of(client, "system.storageReformat") == 0.0


@pytest.mark.parametrize("text", ["", "[1]", "{", '{"a.b": "x"}', '{"a.b": NaN}', '{"a.b": true}'])
def test_a_storage_file_that_is_none_is_one_sentence(tmp_path, text):
    path = tmp_path / "storage.json"
    path.write_text(text)
    with pytest.raises(ServerError, match=r"storage\.json"):
        Storage(path)


def test_a_folder_that_is_not_there_is_one_sentence(tmp_path):
    with pytest.raises(ServerError, match="cannot write the stored parameters"):
        Storage(tmp_path / "no" / "storage.json")


def test_stored_names_that_this_firmware_does_not_have_are_left_alone():
    storage = Storage()
    storage.store("old.parameter", 1.0)
    storage.store("ctrlLee.mass", 1.0)  # was persistent once
    assert value_of(Client(storage=storage), "ctrlLee.mass") == pytest.approx(0.029)
