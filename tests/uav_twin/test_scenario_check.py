"""`uav-twin scenario check`, and the options that all commands have."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from scenarios import scenario_files
from tests.command_line import command, refused, said
from twin_master.errors import MissionInputError
from twin_master.scenario.reading import load_scenario
from twin_master.scenario_check import check_scenario
from uav_twin import cli


def leaves(command: object, *words: str) -> list[tuple[tuple[str, ...], object]]:
    """Return every command with the words that call it."""
    found = [(words, command)]
    for name, inner in getattr(command, "commands", {}).items():
        found += leaves(inner, *words, name)
    return found


def test_every_command_takes_quiet_and_verbose() -> None:
    from reporting import terminal

    everything = leaves(terminal.with_common_options(cli.app))
    assert len(everything) > 25
    for words, leaf in everything:
        options = [option for parameter in leaf.params for option in parameter.opts]  # type: ignore[attr-defined]
        for option in ("--quiet", "-q", "--verbose", "-v"):
            assert options.count(option) == 1, (words, option)
        assert leaf.help, words  # type: ignore[attr-defined]


def test_a_scenario_is_described() -> None:
    text = said("scenario", "check", "level_turns")
    assert "Flown: FMU of the reduced model of the design UAV wing." in text
    assert "Believed: reduced model of the design UAV wing." in text
    assert "25 states, z1 (5 levels), z2 (5 levels)" in text
    assert "50 turns, 10 ahead" in text
    record = json.loads(said("scenario", "check", "level_turns", "--json", "-q"))
    assert (record["states"], record["turns"], record["sensors"]) == (25, 50, 24)
    # at least predictions (E, S, U, G), transitions (U, S, S) and beliefs of 60 steps
    assert record["memory"] > 8 * (100 * 25 * 2 * 24 + 2 * 25**2 + 25 * 60)
    assert said("scenario", "check", "level_turns", "-q") == ""
    assert "no_such.nc" in refused("scenario", "check", "level_turns", "--calibration", "no_such.nc")
    assert "exclude each other" in refused("scenario", "check", "level_turns", "-q", "-v", code=2)


@pytest.mark.parametrize("name", sorted(scenario_files()))
def test_every_shipped_scenario_is_sound_or_says_what_it_needs(name: str) -> None:
    if name == "model_mismatch":  # it names no strain library of its own
        with pytest.raises(MissionInputError, match="--strain-library FILE"):
            check_scenario(load_scenario(name))
        return
    found = check_scenario(load_scenario(name))
    assert found.name == name
    assert found.memory > 0


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        (
            'role = "strain"',
            'role = "stress"',
            "The binding uav_wing has no observation 'stress'",
        ),
        (
            "standard_deviation_microstrain = 125",
            'unit = "percent"\nstandard_deviation_microstrain = 125',
            "gives value 1 of `strain` in 1, and `observation.unit` of the scenario says percent",
        ),
        ('design = "uav_wing"', 'design = "my_wing.toml"', "my_wing.toml cannot be read"),
        ('binding = "uav_wing"', 'binding = "my_binding.toml"', "my_binding.toml cannot be read"),
        ("steps = 50", "steps = -1", "steps"),
        (
            "standard_deviation_microstrain = 125",
            "standard_deviation = 125",
            "write `observation.standard_deviation_microstrain = 125`",
        ),
    ],
)
def test_a_fault_is_one_sentence(old: str, new: str, sentence: str, tmp_path: Path) -> None:
    text = scenario_files()["level_turns"].read_text(encoding="utf-8")
    assert old in text
    (tmp_path / "mine.toml").write_text(text.replace(old, new), encoding="utf-8")
    done = command("scenario", "check", tmp_path / "mine.toml")
    assert (done.returncode, done.stdout) == (1, "")
    assert sentence in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


def test_version() -> None:
    from importlib.metadata import version

    assert said("--version") == f"uav-twin {version('uav-twin')}\n"


def test_ctrl_c_ends_every_command_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("fe.wing.design.load_design", interrupted)
    assert refused("wing", code=130) == "Interrupted."


def test_verbose_shows_the_traceback_and_the_sentence() -> None:
    sentence = refused("scenario", "check", "nowhere")
    told = command("scenario", "check", "nowhere", "-v").stderr
    assert "Traceback" in told
    assert told.strip().endswith(sentence)
