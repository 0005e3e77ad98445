"""The policy of the guard: the shipped file, files of others, hostile ones, and which URIs are written to unasked."""

import json
import math
import threading
import tomllib
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazyem.api.flying import simulated
from crazyem.cli import main, parser
from crazyem.commands.flights import confirm_in_terminal, write_rules
from crazyem.errors import FileFormatError
from crazyem.live.guard import Limits
from crazyem.live.policy import EndRules, Policy, default_text, load_policy, parse_policy


def test_the_shipped_file_says_what_the_code_assumes():
    assert load_policy() == Policy()
    named = tomllib.loads(default_text())
    assert {s: set(v) for s, v in named.items() if s != "name"} == {s: set(v) for s, v in Policy().entries().items()}


def test_a_file_changes_what_it_names_and_nothing_else(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text('name = "mine"\n[push]\nparameters = ["mass"]\nslew = 0.05\n[health]\ntilt_deg = 30\n'
                    '[mass]\nbounds_kg = [0.02, 0.05]\n[end]\nlanded = "restore"\n')  # fmt: skip
    policy = load_policy(path)
    assert policy.limits == replace(Limits(), parameters=("mass",), slew=0.05, mass_absolute=(0.02, 0.05))
    assert policy.health.tilt == pytest.approx(math.pi / 6)
    assert policy.end == replace(EndRules(), landed="restore")
    assert policy.watch == Policy().watch
    assert parse_policy(policy.to_toml(against=load_policy())) == policy


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[push]\nslow = 1", "unknown key 'push.slow'"),
        ("[pull]\nslew = 1", "unknown key 'pull'"),
        ("push = 3", "'push' must be a table"),
        ("[push]\nslew = 0.9", "'push.slew' must be a number in"),
        ("[push]\nslew = nan", "'push.slew' must be a number in"),
        ("[push]\nslew = true", "'push.slew' must be a number in"),
        ("[push]\ninterval_s = inf", "'push.interval_s' must be a number in"),
        ('[push]\nparameters = ["Jxx"]', "a list of mass, Ixx, Iyy, Izz"),
        ('[push]\nparameters = ["Ixx"]', "share their scale of gains"),
        ("[mass]\nbounds_kg = [0.05, 0.02]", "rising"),
        ("[mass]\nbounds_kg = [-1, 0.02]", "rising and within"),
        ("[mass]\nbounds_kg = 0.02", "two numbers"),
        ('[end]\nlanded = "forget"', "one of keep, good, restore"),
        ("[end]\nlanded = [1]", "one of keep, good, restore"),
        ("[watch]\nunjudged_writes = 1.5", "a whole number"),
        ("[watch]\nenabled = 1", "true or false"),
        ("name = 3", "'name' must be"),
        ("[push", "not valid TOML"),
    ],
)
def test_what_cannot_be_used_is_named(tmp_path, capsys, text, says):
    path = tmp_path / "odd.toml"
    path.write_text(text)
    with pytest.raises(FileFormatError, match=r"odd\.toml") as error:
        load_policy(path)
    assert says in str(error.value)
    assert main(["policy", str(path)]) == 3
    assert capsys.readouterr().err.count("\n") == 1


keys = st.sampled_from(sorted(f"{s}.{k}" for s, v in Policy().entries().items() for k in v))
values = st.one_of(st.booleans(), st.integers(), st.floats(), st.text(max_size=5), st.lists(st.floats(), max_size=3))


@given(keys, values)
def test_any_value_is_taken_whole_or_refused_in_a_sentence(key, value):
    section, name = key.split(".")
    written = json.dumps(value) if not isinstance(value, float | list) else repr(value)
    try:
        policy = parse_policy(f"[{section}]\n{name} = {written}")
    except FileFormatError:
        return
    again = parse_policy(policy.to_toml())
    assert replace(again, name=policy.name).entries() == policy.entries()


def test_the_command_shows_default_and_files(tmp_path, capsys):
    assert main(["policy"]) == 0
    assert capsys.readouterr().out == default_text()
    path = tmp_path / "mine.toml"
    path.write_text('name = "mine"\n[push]\nslew = 0.05\n')
    assert main(["policy", str(path)]) == 0
    assert "slew = 0.05 # default: 0.15" in capsys.readouterr().out
    assert main(["policy", str(path), "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown["name"] == "mine"
    assert shown["push"]["slew"] == 0.05
    assert main(["policy", str(tmp_path / "none.toml")]) == 2


@pytest.mark.parametrize(
    ("uri", "expected"),
    [
        ("", True),
        ("udp://127.0.0.1:19850", True),
        ("udp://127.0.0.1.example.org:19850", False),
        ("udp://192.168.4.1:2390", False),
        ("udp://localhost:19850", False),  # what a name means is not ours to know
        ("udp://127.0.0.1@10.0.0.1:1", False),
        ("udp://[::1", False),
        ("radio://0/80/2M", False),
        ("serial://127.0.0.1", False),
    ],
)
def test_only_this_host_counts_as_simulated(uri, expected):
    assert simulated(uri) is expected


@pytest.mark.parametrize(
    ("words", "mode"),
    [
        ([], "push"),
        (["udp://127.0.0.1:19850"], "push"),
        (["udp://127.0.0.1:19850", "--dry-run"], "dry run"),
        (["radio://0/80/2M"], "dry run"),
        (["radio://0/80/2M", "--push"], "push"),
        (["radio://0/80/2M", "--confirm"], "push after confirmation"),
        (["--confirm"], "push after confirmation"),
    ],
)
def test_what_may_write(words, mode):
    assert write_rules(parser().parse_args(["fly", *words])).mode == mode


def test_a_policy_of_a_file_reaches_the_guard(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text("[push]\nslew = 0.05\n")
    assert write_rules(parser().parse_args(["fly", "--policy", str(path)])).policy.limits.slew == 0.05


@pytest.mark.parametrize(
    ("answer", "agreed"), [("y\n", True), ("YES\n", True), ("n\n", False), ("\n", False), ("", False)]
)
def test_the_question_is_answered_on_the_terminal(tmp_path, monkeypatch, capsys, answer, agreed):
    path = tmp_path / "typed"
    path.write_text(answer)
    with path.open() as typed:
        monkeypatch.setattr("sys.stdin", typed)
        assert confirm_in_terminal("first write to the drone: ctrlLee.mass = 0.03", threading.Event()) is agreed
    assert "ctrlLee.mass = 0.03" in capsys.readouterr().err


def test_a_question_nobody_waits_for_is_a_no():
    ended = threading.Event()
    ended.set()
    assert not confirm_in_terminal("?", ended)
