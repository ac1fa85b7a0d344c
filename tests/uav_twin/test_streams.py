"""Streams that cannot take what commands write: an encoding without their characters, closed ones."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

EVERY_COMMAND = """
import os
from pathlib import Path
from discrepancy.errors import DiscrepancyError
from reporting import terminal
from tests.uav_twin.test_help import COMMANDS
from twin_master.command import run_command_line
from uav_twin import cli

lines = [["scenarios"], ["--version"]]
for words in sorted(COMMANDS):
    lines += [[*words.split(), "--help"], [*words.split(), "\\u00b5-Pr\\u00fcfling.toml"]]
application = terminal.with_common_options(cli.app)
ends = []
for line in lines:
    try:
        run_command_line(lambda: application(line, prog_name="uav-twin"), DiscrepancyError)
    except SystemExit as end:
        ends.append(f"{' '.join(line)}: {end.code or 0}")
    except BaseException as error:
        ends.append(f"{' '.join(line)}: {type(error).__name__}")
Path(os.environ["ENDS"]).write_text("\\n".join(ends), encoding="utf-8")
"""
"""Calls every command twice: for its help, and with a file that does not exist."""
ROOT = Path(__file__).parents[2]


@pytest.mark.skipif(os.name != "posix", reason="a shell closes the streams")
@pytest.mark.parametrize("streams", ["", "<&- >&- 2>&-"])
def test_every_command_ends_with_a_code_whatever_its_streams_are(tmp_path, streams):
    ends = tmp_path / "ends.txt"
    environment = os.environ | {
        "PYTHONIOENCODING": "" if streams else "ascii",
        "PYTHONPATH": str(ROOT),
        "ENDS": str(ends),
    }
    command = f'exec "$0" -c "$1" {streams}'
    subprocess.run(
        ["sh", "-c", command, sys.executable, EVERY_COMMAND],
        cwd=tmp_path,
        env=environment,
        stdout=subprocess.DEVNULL,
        check=True,
    )
    lines = ends.read_text(encoding="utf-8").splitlines()
    assert len(lines) > 70
    assert [line for line in lines if not line.rpartition(": ")[2].isdigit()] == []
    assert [line for line in lines if "--help" in line and not line.endswith(": 0")] == []


def run_in_ascii(*words: str | Path) -> subprocess.CompletedProcess[str]:
    """Run `uav-twin` with streams that take ASCII alone."""
    return subprocess.run(
        [sys.executable, "-m", "uav_twin", *words],
        env=os.environ | {"PYTHONIOENCODING": "ascii"},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        encoding="ascii",
        check=False,
    )


def test_a_character_that_the_encoding_lacks_becomes_a_question_mark(tmp_path):
    file = tmp_path / "readings.csv"
    file.write_text("Time [s],DMS [\u00b5m/m]\n0,1\n1,2\n2,3\n", encoding="utf-8")
    end = run_in_ascii("discrepancy", "import", file)
    assert "Traceback" not in end.stderr
    assert "?m/m" in end.stdout


def test_json_loses_no_character_in_ascii(tmp_path):
    mesh = tmp_path / "m\u00fchle.inp"
    shutil.copy(ROOT / "scenarios/structures/bracket.inp", mesh)
    structure = tmp_path / "m\u00fchle.toml"
    text = (ROOT / "scenarios/structures/bracket.toml").read_text(encoding="utf-8")
    structure.write_text(text.replace("bracket.inp", "m\u00fchle.inp"), encoding="utf-8")
    end = run_in_ascii("structure", "info", structure, "--json", "--quiet")
    assert "m\\u00fchle" in end.stdout
    assert json.loads(end.stdout)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device is always full")
@pytest.mark.parametrize("words", [("scenarios",), ("--version",), ("schema", "binding")])
def test_a_full_disk_for_the_output_of_a_command_is_one_sentence(words):
    with Path("/dev/full").open("w", encoding="utf-8") as full:
        ended = subprocess.run(
            [sys.executable, "-m", "uav_twin", *words],
            cwd=ROOT,
            stdout=full,
            stderr=subprocess.PIPE,
            encoding="utf-8",
            check=False,
        )
    assert ended.returncode == 1
    assert ended.stderr == (
        "No space is left on the disk for the output of this command: free some space, or send the "
        "output elsewhere, and repeat.\n"
    )
