"""What helps to type a command: examples and headings in the help, completion, names that are meant."""

import inspect
import os
import re
import shlex
import subprocess
import sys
from typing import Any

import pytest
from rich.text import Text

from reporting import terminal
from reporting.choices import did_you_mean
from tests.command_line import refused, said
from uav_twin import cli

EXAMPLE = re.compile(r"^Example: `uav-twin (.*)`$", re.MULTILINE)


def commands_by_words() -> dict[str, Any]:
    """Return every command of the command line by the words that call it."""

    def walk(command: Any, words: str) -> None:
        subcommands = getattr(command, "commands", {})
        if not subcommands or command.invoke_without_command:
            found[words] = command
        for name, subcommand in subcommands.items():
            walk(subcommand, f"{words} {name}".strip())

    found: dict[str, Any] = {}
    for name, command in terminal.with_common_options(cli.app).commands.items():  # type: ignore[attr-defined]
        walk(command, name)
    return found


COMMANDS = commands_by_words()


def example_of(words: str) -> str:
    """Return the example in the help of a command, of which there is one."""
    (example,) = EXAMPLE.findall(inspect.cleandoc(COMMANDS[words].help))
    return str(example)


@pytest.mark.parametrize("words", sorted(COMMANDS))
def test_the_help_of_a_command_ends_with_one_example(words):
    assert example_of(words)
    assert inspect.cleandoc(COMMANDS[words].help).endswith("`")


def test_the_help_loses_no_word_in_brackets():
    """The help is read as markup, in which [mm] is a style."""
    texts = []
    for command in COMMANDS.values():
        helps = [parameter.help for parameter in command.params if hasattr(parameter, "help")]
        texts += [text for text in (command.help, *helps) if text]
    assert len(texts) > 100
    assert [text for text in texts if Text.from_markup(text).plain != text] == []


@pytest.mark.parametrize("words", sorted(COMMANDS))
def test_a_command_understands_its_example(words):
    count = len(words.split())
    arguments = shlex.split(example_of(words))
    context = COMMANDS[words].make_context(words, arguments[count:])
    assert arguments[:count] == words.split()
    assert context.args == []


def test_commands_stand_under_headings():
    text = said("--help")
    order = [text.index(f" {heading} ") for heading in (cli.MISSIONS, cli.MODELS, cli.MEASUREMENTS)]
    assert order == sorted(order)
    assert " Commands " not in text  # a command without a heading would stand there


@pytest.mark.parametrize(
    ("line", "expected", "absent"),
    [
        ("run le", "level_turns", "pump_wear"),
        ("scenario check fail", "failing_gauges", "level_turns"),
        ("structure info br", "bracket", "level_turns"),
        ("discrepancy run campaign --model single", "single_mass_rig", "three_mass_chain"),
        ("discrepancy effects --show cou", "coulomb_friction", "bouc_wen_hysteresis"),
        ("structure info bracket --mem", "--memory-limit", "--modes"),
    ],
)
def test_the_shell_completes_names_of_what_is_shipped(line, expected, absent):
    words = f"uav-twin {line}"
    environment = os.environ | {
        "_UAV_TWIN_COMPLETE": "complete_bash",
        "COMP_WORDS": words,
        "COMP_CWORD": str(len(words.split()) - 1),
    }
    program = [sys.executable, "-c", "from uav_twin.cli import main; main()"]
    done = subprocess.run(program, env=environment, capture_output=True, text=True, check=False)
    suggestions = done.stdout.split()
    assert expected in suggestions
    assert absent not in suggestions


@pytest.mark.parametrize(
    ("line", "meant"),
    [
        ("run level_turn", "level_turns"),
        ("scenario check Level_Turns", "level_turns"),
        ("discrepancy effects --show coulomb_fricton", "coulomb_friction"),
        ("discrepancy example static out --model single_mass", "single_mass_rig"),
        ("discrepancy example static out --model brackt", "bracket"),
        ("structure info brackt", "bracket"),
        ("structure fmu brackt", "bracket"),
    ],
)
def test_a_misspelt_name_is_refused_with_the_name_that_is_meant(line, meant, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert refused(*line.split()).endswith(f"Did you mean `{meant}`?")
    assert not list(tmp_path.iterdir())


def test_no_name_is_suggested_where_none_is_like_it():
    assert did_you_mean("nowhere", ("level_turns", "bracket")) == ""
    assert "Did you mean" not in refused("scenario", "check", "nowhere")
