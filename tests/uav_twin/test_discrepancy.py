"""`uav-twin discrepancy` as a user calls it: import, with a terminal and without, example, check and run."""

import itertools
import json
import os
import pty
import re
import select
import shlex
import sys
from contextlib import redirect_stderr, redirect_stdout, suppress
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest

from discrepancy.campaign.reading import read_campaign
from discrepancy.campaign.records import Campaign, Quantity, TrialKind
from discrepancy.files.verdict import read_patch, read_verdict_file
from discrepancy.model_choice import choose_model
from discrepancy.search.strategy import Search
from discrepancy.sources.examples import example_campaign, plan_from_scales
from tests import command_line
from tests.command_line import Terminal, command, refused, said

MODEL = "single_mass_rig"
RIG = ("--model", MODEL)
COLUMNS = ("--column", "Weg=displacement", "--column", "Dehnung=leaf_strain")


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Work in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


IMPORT = ("discrepancy", "import")


def laboratory(folder: Path) -> Campaign:
    """Return a simulated campaign, its trials written as a laboratory's programme writes them."""
    model = choose_model(MODEL).model
    plan = plan_from_scales(model, ("displacement", "leaf_strain"), model.description.input[0].name)  # type: ignore[attr-defined]
    campaign = example_campaign(model, "laboratory", 1, plan)

    def german(values: np.ndarray, power: int) -> list[str]:
        return [str(Decimal(repr(value)).scaleb(power)).replace(".", ",") for value in values.tolist()]

    for trial in campaign.trials:
        still = trial.kind is TrialKind.STATIC
        lead = german(trial.force, -3) if still else german(trial.time, 3)
        head = f"Versuch {trial.name};;\n\n{'Kraft;Weg;Dehnung' if still else 'Zeit;Weg;Dehnung'}\n"
        head += "kN;mm;µm/m\n" if still else "ms;mm;µm/m\n"
        columns = (lead, german(trial.values[:, 0], 3), german(trial.values[:, 1], 6))
        rows = "".join(";".join(row) + "\n" for row in zip(*columns, strict=True))
        text = f"{head}{rows}Mittelwert;1,0;2,0\n"
        (folder / f"{trial.name}.csv").write_bytes(text.encode("latin-1"))
    return campaign


def test_a_folder_of_files_becomes_the_campaign():
    campaign = laboratory(Path())
    files = [f"{trial.name}.csv" for trial in campaign.trials]
    kinds = [f"{trial.name}.csv={trial.kind.value}" for trial in campaign.trials]
    releases = [f"{t.name}.csv={1e3 * t.release.displacement!r}mm" for t in campaign.trials if t.release]
    options = [word for kind in kinds for word in ("--kind", kind)]
    options += [word for release in releases for word in ("--release", release)]
    done = command(
        *IMPORT, *files, *options, *COLUMNS, "--out", "lab", "--load-place", "mass", "--model", MODEL
    )
    assert (done.returncode, done.stderr) == (0, "")
    read = read_campaign("lab")
    assert [trial.name for trial in read.trials] == [trial.name for trial in campaign.trials]
    for ours, theirs in zip(read.trials, campaign.trials, strict=True):
        assert ours.kind is theirs.kind
        for name in ("values", "time", "force"):
            if name != "time" or ours.is_dynamic:
                np.testing.assert_allclose(getattr(ours, name), getattr(theirs, name), rtol=1e-14)
        assert ours.load_place == "mass"
        if theirs.release is not None:
            assert ours.release.displacement == pytest.approx(theirs.release.displacement, rel=1e-15)
    origin = next(remark for remark in read.remarks if "release 1.csv" in remark)
    assert "Imported from release 1.csv (SHA-256 " in origin
    assert "'Zeit' [ms] is time, 'Weg' [mm] is displacement and 'Dehnung' [µm/m] is leaf_strain" in origin


TWO = {
    "pull.csv": b"F;Weg;Temp [K];U [V];q\n1;1,234;293;0;5\n2;2,345;293;1;5\n",
    "swing.csv": b"t [ms];Weg\n" + b"".join(b"%d;%d,000\n" % (2 * k, k % 7 + 1) for k in range(9)),
}


def test_everything_that_is_not_said_is_named_at_once():
    for name, content in TWO.items():
        Path(name).write_bytes(content)
    sentence = refused(*IMPORT, *TWO, "--kind", "swing.csv=ringdown")
    for part in (
        "13 answers are missing, and nothing was written",
        "--decimal NAME=... for 'pull.csv' (. or ,: '1,234' in line 2 can be read as both)",
        "--unit NAME=... for 'F', 'Weg' and 'q' (such as mm, kN or ms",
        "--quantity NAME=... for 'U' (signal or voltage: V is a unit of each)",
        "--release NAME=... for 'swing.csv' (displacement at which the release point was held",
    ):
        assert part in sentence
    assert sentence.strip().endswith("To have the outputs of your model listed, give --model.")


def test_the_outputs_of_the_model_are_listed_with_their_units_where_a_column_may_be_one_of_them():
    Path("swing.csv").write_bytes(TWO["swing.csv"])
    outputs = "displacement (displacement in m) and leaf_strain (strain without a unit)"
    options = ("swing.csv", "--kind", "ringdown", "--release", "8mm", "--decimal", ",", "--model", MODEL)
    assert f"The model has the outputs {outputs}." in refused(*IMPORT, *options)
    wrong = ("--column", "Weg=deflection", "--unit", "Weg=mm")
    assert f"the model has no output 'deflection'; it has {outputs}; say another." in refused(
        *IMPORT, *options, *wrong
    )
    _, screen = in_a_terminal(["deflection", "displacement", "mm", "", "", "y"], *options, "--out", "lab")
    assert screen.index(f"The model has the outputs {outputs}.") < screen.index("Weg: column")
    assert [channel.output for channel in read_campaign("lab").channels.values()] == ["displacement"]


def test_samples_at_rest_inputs_temperatures_and_remarks_of_origins_and_assumptions_only():
    for name in ("n1", "n2"):
        rest = "".join(f"{k / 100},{(k * 7) % 11 - 5},20\n" for k in range(40))
        Path(f"{name}.csv").write_text(f"time [s],x [um],temperature [degC]\n{rest}", "utf-8")
    rows = "".join(f"{k / 100},{'' if k == 3 else k % 5},{k},{k / 8},{20 + k / 8}\n" for k in range(16))
    head = "time [s],x [um],pull [mN],leaf_strain [mV/V],temperature [°C]"
    Path("push.csv").write_text(f"{head}\n{rows}", "utf-8")
    given = (
        "--kind", "noise", "--kind", "push.csv=driven", "--column", "x=displacement", "--column",
        "pull=input:pull", "--reference-temperature", "20", "--model", MODEL, "--out", "lab",
    )  # fmt: skip
    done = command(*IMPORT, "push.csv", "n1.csv", "n2.csv", *given)
    assert done.returncode == 1
    assert (
        done.stderr.strip()
        == "Noise is read from one file, but n1.csv and n2.csv were given: give one of them."
    )
    said(*IMPORT, "push.csv", "n1.csv", *given)
    toml = Path("lab/campaign.toml").read_text("utf-8")
    assert "begins" not in toml
    assert toml.count("Imported from") == 2
    assert toml.split("]\n\n[")[0].count('",\n') == 3  # and that zeros and gains were assumed
    assert "; 1 cell is empty." in toml
    read = read_campaign("lab")
    noise = read.channels["x"].noise
    assert noise.samples is not None
    assert noise.interval == pytest.approx(0.01)
    (trial,) = read.trials
    assert [item.name for item in trial.inputs] == ["pull"]
    assert trial.inputs[0].values[3] == 3e-3
    assert trial.temperature[8] == 1.0
    assert read.channels["leaf_strain"].quantity is Quantity.SIGNAL
    assert "(assumed; set `begins`" in " ".join(read.remarks)
    Path("lab/campaign.toml").write_text(toml.replace('"driven"', '"driven"\nbegins = "still"'), "utf-8")
    assert "(assumed; set `begins`" not in " ".join(read_campaign("lab").remarks)
    Path("step.csv").write_text("time [s],n [g],x [um]\n0,1,2\n1,2.5,3\n", "utf-8")
    said(*IMPORT, "step.csv", "--kind", "flight", "--column", "n=load_factor", "--column", "x=x")
    assert read_campaign("step").trials[0].load_factor.tolist() == [1.0, 2.5]


def test_the_force_of_a_ring_down_is_none_though_a_column_gives_it():
    rows = "".join(f"{k / 100},{k % 5},{k},7\n" for k in range(16))
    Path("push.csv").write_text(f"time [s],force [N],x [in],q\n{rows}", "utf-8")
    given = ("--kind", "ringdown", "--column", "x=x", "--column", "q=-", "--release", "-0.5in")
    said(*IMPORT, "push.csv", *given, "--out", "b")
    (trial,) = read_campaign("b").trials
    assert (trial.force.tolist(), trial.values.shape) == ([0.0] * 16, (16, 1))
    assert (trial.values[1, 0], trial.release.displacement) == (0.0254, -0.0127)


def test_the_documented_files_print_the_documented_tables():
    page = (Path(__file__).parents[2] / "docs" / "how_to" / "laboratory_files.md").read_text("utf-8")
    blocks = re.findall(r"^```\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    loading, release, asked, given, written, checked = blocks[:6]
    Path("loading.csv").write_text(loading, "utf-8-sig")
    Path("release.csv").write_bytes(release.encode("latin-1"))
    for block in (asked, given):
        line, _, screen = block.replace("\\\n", "").partition("\n")
        done = command(*shlex.split(line)[1:])
        shown = [row.rstrip() for row in (done.stdout + done.stderr).splitlines() if row.strip()]
        assert [row.rstrip() for row in screen.splitlines() if row.strip()] == shown
    assert Path("lab/02_release.csv").read_text("utf-8").startswith(written.rpartition("...")[0])
    done = command("discrepancy", "check", "lab", "--model", "single_mass_rig")
    assert done.returncode == 1
    assert [row for row in done.stdout.splitlines() if row.startswith("Fault: ")] == checked.splitlines()
    stored_hashes = re.findall(r"SHA-256 ([0-9a-f]{64})\b", Path("lab/campaign.toml").read_text("utf-8"))
    printed_hashes = re.findall(r"SHA-256 ([0-9a-f]+)", done.stdout)
    assert len(stored_hashes) == 2  # a line of the output has 12 digits of each, once
    assert printed_hashes == [stored[:12] for stored in stored_hashes]


# ---------------------------------------------------------------- a terminal


def in_a_terminal(answers: list[str], *words: object) -> tuple[int, str]:
    """Return exit code and screen of the command, its questions answered one after the other."""
    screen = Terminal()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(screen), redirect_stderr(screen):
        patch.setattr(sys, "stdin", Terminal("\n".join([*answers, ""])))
        code = command_line.call(patch, *IMPORT, *words)
    return code, screen.getvalue()


def test_a_terminal_is_asked(tmp_path):
    """And a no writes nothing."""
    (tmp_path / "swing.csv").write_bytes(TWO["swing.csv"])
    code, screen = in_a_terminal(["ringdown", ",", "tip", "mm", "12 mm", "", "", "n"], "swing.csv")
    assert code == 1, screen
    assert "Nothing was written." in screen
    assert [path.name for path in Path().iterdir()] == ["swing.csv"]
    answers = ["swinging", "ringdown", ",", "tip", "miles per hour", "mm", "12 mm", "a bit", "0.5mm", "", "y"]
    code, screen = in_a_terminal(answers, "swing.csv", "--out", "lab")
    assert code == 0, screen
    assert (
        "--kind must be static, ringdown, forced, driven, flight or noise, but 'swinging' was given."
        in screen
    )
    assert "Write lab?" in screen
    read = read_campaign(tmp_path / "lab")
    assert read.trials[0].values[1, 0] == 2e-3
    assert read.trials[0].release.displacement == 0.012
    assert "--zero of 'Weg' must be a standard deviation such as 0.1mm or 1%" in screen
    assert read.channels["Weg"].offset_deviation == pytest.approx(0.0005, rel=1e-12)
    assert read.channels["Weg"].gain_deviation == 0.02


class PseudoTerminal:
    """The import as a process at a pseudo-terminal, as a user has it."""

    def __init__(self, *words: object) -> None:
        self.screen = ""
        self._read_until = 0  # the position in the screen up to which the test has read
        command_words = [sys.executable, "-m", "uav_twin", *IMPORT, *map(str, words)]
        self._process, self._terminal = pty.fork()
        if self._process == 0:
            os.execve(sys.executable, command_words, {**os.environ, "COLUMNS": "1000", "TERM": "dumb"})

    def wait_for(self, text: str) -> str:
        """Wait until the screen shows a text after what was read before; return what stands before it."""
        while (place := self.screen.find(text, self._read_until)) < 0:
            ready, _, _ = select.select([self._terminal], [], [], 240.0)
            assert ready, self.screen
            self.screen += os.read(self._terminal, 4096).decode()
        before = self.screen[self._read_until : place]
        self._read_until = place + len(text)
        return before

    def type(self, text: str) -> None:
        os.write(self._terminal, text.encode())

    def end(self) -> int:
        """Read until the process ends, and return its exit code."""
        with suppress(OSError):  # raised at the end of the process
            while part := os.read(self._terminal, 4096):
                self.screen += part.decode()
        os.close(self._terminal)
        return os.waitstatus_to_exitcode(os.waitpid(self._process, 0)[1])


def printed_command(screen: str, beginning: str) -> list[str]:
    """Return the words of a command that the screen shows after a beginning, without the program."""
    plain_text = re.sub(r"\x1b\[[0-9;]*m", "", screen)  # without colours
    line = next(row for row in plain_text.splitlines() if row.startswith(beginning))
    return shlex.split(line.removeprefix(beginning))[3:]


def test_an_interrupted_dialogue_goes_on_with_its_answers_and_its_command_repeats_it_without_questions():
    Path("swing.csv").write_bytes(TWO["swing.csv"])
    terminal = PseudoTerminal("swing.csv", "--out", "lab")
    terminal.wait_for("questions to answer")
    terminal.wait_for("swing.csv: kind")
    terminal.type("ringdown\n")
    terminal.wait_for("swing.csv: decimal")
    terminal.type(",\n")
    terminal.wait_for("Weg: column")
    terminal.type("tip of the wing\n")
    terminal.wait_for("Weg: unit")
    terminal.type("\x03")  # Ctrl-C
    assert terminal.end() == 130
    assert not Path("lab").exists()
    words = printed_command(terminal.screen, "Nothing was written. To go on with these answers: ")
    assert words[:3] == ["swing.csv", "--out", "lab"]

    terminal = PseudoTerminal(*words)
    assert "kind," not in terminal.wait_for("Weg: unit")  # what was answered is not asked again
    terminal.type("mm\n")
    terminal.wait_for("swing.csv: release")
    terminal.type("12 mm\n")
    terminal.wait_for("Weg: zero")
    terminal.wait_for("[1%]")
    terminal.type("0.5mm\n")
    terminal.wait_for("Weg: gain")
    terminal.type("\n")
    terminal.wait_for("Write lab?")
    terminal.type("y\n")
    assert terminal.end() == 0
    read = read_campaign("lab")
    assert [channel.output for channel in read.channels.values()] == ["tip of the wing"]
    assert read.channels["Weg"].offset_deviation == pytest.approx(0.0005, rel=1e-12)

    words = printed_command(terminal.screen, "To repeat it without questions: ")
    words[words.index("lab")] = "again"
    code, screen = in_a_terminal([], *words)  # a terminal without a user
    assert code == 0, screen
    assert Path("again/campaign.toml").read_bytes() == Path("lab/campaign.toml").read_bytes().replace(
        b'"lab"', b'"again"'
    )


def test_a_file_that_is_not_held_out_is_an_answer_too():
    swings("a.csv", "b.csv")
    words = ("--kind", "driven", *PLAIN, "--held-out", "b.csv", "--held-out", "a.csv=no")
    said(*IMPORT, "a.csv", "b.csv", *words)
    assert [trial.held_out for trial in read_campaign("a").trials] == [False, True]


SWINGS = ("t [ms],x [um],U [V]", *(f"{10 * k},{k % 5 - 2}0,{0.5 * k}" for k in range(16)))
PLAIN = ("--column", "x=x", "--column", "U=-")


def swings(*names: str, first_column: bool = True) -> None:
    """Write records in time: a displacement of up to 20 um, and a voltage."""
    rows = [row if first_column else row.partition(",")[2] for row in SWINGS]
    for name in names:
        Path(name).write_text("\n".join(rows) + "\n", "utf-8")


def test_zeros_and_gains_that_nobody_states_are_not_exact():
    swings("a.csv")
    printed = said(*IMPORT, "a.csv", "--kind", "driven", *PLAIN)
    sentence = (
        "Zeros and gains without a stated standard deviation are assumed to be known: "
        "the zero of 'x' to 0.2 um and the gain of 'x' to 2 %."
    )
    read = read_campaign("a")
    assert read.channels["x"].offset_deviation == pytest.approx(2e-7, rel=1e-12)
    assert read.channels["x"].gain_deviation == 0.02
    assert sentence in " ".join(printed.split())
    assert sentence in read.remarks


@pytest.mark.parametrize(
    ("zero", "gain", "known"),
    [
        ("exact", "exact", (0.0, 0.0)),
        ("free", "0.5%", (np.inf, 0.005)),
        ("x=0.001mm", "x=0.03", (1e-6, 0.03)),
        ("3", "x=exact", (3e-6, 0.0)),
    ],
)
def test_zeros_and_gains_are_as_stated(zero, gain, known):
    swings("a.csv")
    printed = said(*IMPORT, "a.csv", "--kind", "driven", *PLAIN, "--zero", zero, "--gain", gain)
    channel = read_campaign("a").channels["x"]
    assert (channel.offset_deviation, channel.gain_deviation) == pytest.approx(known, rel=1e-12)
    assert "assumed" not in printed


def test_holds_begins_and_files_for_proof_are_written():
    swings("a.csv", "b.csv")
    given = ("--kind", "driven", "--column", "x=x", "--column", "U=input:U", "--quantity", "U=voltage")
    said(*IMPORT, "a.csv", "b.csv", *given, "--hold", "U=zero_order", "--begins", "a.csv=still",
         "--begins", "b.csv=unknown", "--held-out", "b.csv")  # fmt: skip
    read = read_campaign("a")
    assert [(trial.begins.value, trial.held_out) for trial in read.trials] == [
        ("still", False),
        ("unknown", True),
    ]
    assert [item.hold.value for item in read.trials[0].inputs] == ["zero_order"]


def test_a_table_without_a_time_has_the_interval_that_is_stated():
    swings("a.csv", first_column=False)
    given = (*IMPORT, "a.csv", "--kind", "driven", *PLAIN)
    assert "--interval NAME=... for 'a.csv' (seconds between its rows" in refused(*given)
    said(*given, "--interval", "0.02")
    assert read_campaign("a").trials[0].time.tolist() == [0.02 * k for k in range(16)]
    swings("b.csv")
    sentence = refused(*IMPORT, "b.csv", "--kind", "driven", *PLAIN, "--interval", "b.csv=0.02")
    assert "b.csv has a column of times, but --interval was given for it" in sentence


def test_a_table_of_one_column_has_the_interval_that_is_stated():
    cells = [f"{row % 5}.5" for row in range(9)]
    Path("a.csv").write_text("\n".join(["acc [g]", *cells]) + "\n", "utf-8")
    printed = said(*IMPORT, "a.csv", "--kind", "driven", "--column", "acc=acc", "--interval", "0.02")
    assert "a.csv: driven; lines 2 to 10; decimal points" in printed
    (trial,) = read_campaign("a").trials
    assert trial.time.tolist() == [0.02 * k for k in range(9)]
    np.testing.assert_allclose(trial.values[:, 0], [9.80665 * float(cell) for cell in cells], rtol=1e-14)


def test_inputs_and_forces_keep_the_units_of_the_file():
    """Of inputs in `[[input]]`, and of the force of a forced trial in `force_unit`."""
    rows = "".join(f"{k / 100},{k},{k % 3}\n" for k in range(9))
    Path("push.csv").write_text(f"time [s],pull [lbf],x [in]\n{rows}", "utf-8")
    given = (*IMPORT, "push.csv", "--column", "x=x")
    said(
        *given, "--kind", "driven", "--column", "pull=input:pull", "--zero", "pull=0.5lbf", "--out", "driven"
    )
    said(*given, "--kind", "forced", "--column", "pull=force", "--out", "forced")
    pounds = 4.4482216152605
    for kind, word in (("driven", "pull"), ("forced", "force")):
        head, _, third, *_ = Path(kind, "01_push.csv").read_text("utf-8").splitlines()
        assert (head, third) == (f"time,{word},x", "0.01,1.0,1.0")
        (trial,) = read_campaign(kind).trials
        np.testing.assert_allclose(trial.force, pounds * np.arange(9.0), rtol=1e-14)
    (pull,) = read_campaign("driven").trials[0].inputs
    assert (pull.unit, pull.offset_deviation) == ("lbf", pytest.approx(0.5 * pounds, rel=1e-14))
    assert 'force_unit = "lbf"' in Path("forced/campaign.toml").read_text("utf-8")
    toml = Path("forced/campaign.toml").read_text("utf-8").replace('"lbf"', '"mm"')
    Path("forced/campaign.toml").write_text(toml, "utf-8")
    sentence = refused("discrepancy", "check", "forced", *RIG)
    assert "force must have a unit such as N, mN or kN, but 'mm' was given" in sentence


@pytest.mark.parametrize(
    ("scale", "in_newtons"), [("200 N/V", 100.0), ("0.2 kN/V", 100.0), ("200 N/mV", 1e5), ("-2 kN/V", -1e3)]
)
def test_a_scale_makes_a_voltage_a_force(scale, in_newtons):
    swings("a.csv")
    given = ("--kind", "driven", "--column", "x=x", "--column", "U=input:F")
    said(*IMPORT, "a.csv", *given, "--scale", f"U={scale}")
    (force,) = read_campaign("a").trials[0].inputs
    assert (force.quantity, force.values[1]) == (Quantity.FORCE, pytest.approx(in_newtons, rel=1e-12))


def test_a_scale_of_a_mere_number_keeps_the_unit_and_one_of_another_unit_is_refused():
    swings("a.csv")
    said(*IMPORT, "a.csv", "--kind", "driven", *PLAIN, "--scale", "x=-1")
    assert read_campaign("a").trials[0].values[0, 0] == pytest.approx(20e-6, rel=1e-14)
    sentence = refused(*IMPORT, "a.csv", "--kind", "driven", *PLAIN, "--scale", "x=200 N/V", "--out", "b")
    assert "--scale of 'x' is for cells in V, but they are in um" in sentence


def test_channels_keep_the_units_and_digits_of_the_files():
    swings("a.csv")
    said(*IMPORT, "a.csv", "--kind", "driven", *PLAIN)
    assert 'unit = "um"' in Path("a/campaign.toml").read_text("utf-8")
    assert Path("a/01_a.csv").read_text("utf-8").splitlines()[:3] == ["time,x", "0.0,-20.0", "0.01,-10.0"]


@pytest.fixture
def campaign(tmp_path: Path) -> Path:
    """A static campaign of the single-mass rig with a seating offset."""
    folder = tmp_path / "rig test"
    given = ("static", str(folder), *RIG, "--seed", "3", "--effect", "seating_offset@A:offset_ratio=0.08")
    said("discrepancy", "example", *given)
    return folder


def columns(shown: str, heads: str) -> dict[str, list[str]]:
    """Return the rows of a printed table by their first cells; cells stand two blanks apart, or more."""
    lines = iter(shown.splitlines())
    assert any(re.split(r"  +", line.strip()) == heads.split("|") for line in lines)
    rows = (re.split(r"  +", line.strip()) for line in itertools.takewhile(str.strip, lines))
    return {first: rest for first, *rest in rows if rest}


def test_from_an_example_to_a_verdict(campaign, tmp_path):
    table = (campaign / "campaign.toml").read_text(encoding="utf-8")
    (campaign / "campaign.toml").write_text(table.replace("held_out = true", "held_out = false"), "utf-8")
    shown = said("discrepancy", "check", str(campaign), *RIG)
    seen = columns(shown, "effect|shows best at|parameter|detectable from|prior median")
    assert seen["seating_offset"][:2] == ["A", "offset ratio"]
    assert 0.0 < float(seen["seating_offset"][2]) < float(seen["seating_offset"][3]) == 0.03
    assert "Not testable: washout and inertia_relief. The campaign has no flight trial to fit." in shown
    assert "Note: Held out for proof by the rule of the workflow: unloading." in shown
    out = tmp_path / "verdict"
    shown = said("discrepancy", "run", str(campaign), *RIG, "--out", str(out), "--calibrate", "1")
    stored = read_verdict_file(out / "verdict.json")
    assert f"Verdict: {stored.verdict.kind.value}" in shown
    assert "seating_offset" in stored.verdict.inclusion
    (named,) = columns(shown, "effect|place|parameter|value|90 % interval").items()
    low, high = map(float, named[1][3].split(" to "))
    assert (named[0], *named[1][:2]) == ("seating_offset", "A", "offset ratio")
    assert low < float(named[1][2]) < high
    assert stored.origin.command == (
        f"uav-twin discrepancy run '{campaign.resolve()}' --model single_mass_rig --seed 0 --calibrate 1"
    )
    assert stored.origin.short_command == (
        "uav-twin discrepancy run 'rig test' --model single_mass_rig --seed 0 --calibrate 1"
    )
    assert "seating_offset" in {effect.identifier for effect in read_patch(out / "patch.json").effects}
    tried = json.loads((out / "self_calibration.json").read_text(encoding="utf-8"))
    assert len(tried["cases"]) == 1
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "seating offset" in page
    assert str(tmp_path) not in page
    # a second time: only on demand (that it comes to the same conclusion is tested in test_workflow.py)
    assert "--replace" in refused("discrepancy", "run", str(campaign), *RIG, "--out", str(out))


def test_an_interrupted_search_keeps_what_it_has_found(campaign, tmp_path):
    """Ctrl-C comes when single effects are compared; another run takes the place of what was kept."""
    out = tmp_path / "verdict"
    run = ("discrepancy", "run", str(campaign), *RIG, "--out", str(out), "--no-report")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Search, "search_sets", interrupt)
        words = refused(*run, code=130)
    kept = out / "verdict_so_far.json"
    assert f"Interrupted; the hypotheses fitted until then are in {kept}." in words
    record = json.loads(kept.read_text(encoding="utf-8"))
    assert record["schema"] == "uav-twin verdict so far 1"
    assert record["hypotheses"][0]["effects"][0]["identifier"] == "seating_offset"
    assert sum(item["probability"] for item in record["hypotheses"]) == pytest.approx(1.0, abs=1e-3)
    said(*run)
    assert not kept.exists()
    assert (out / "verdict.json").is_file()


def test_a_search_that_is_interrupted_before_it_has_found_anything_leaves_no_folder(campaign, tmp_path):
    out = tmp_path / "verdict"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("discrepancy.workflow.check_data", interrupt)
        words = refused("discrepancy", "run", str(campaign), *RIG, "--out", str(out), code=130)
    assert "Interrupted." in words
    assert not out.exists()


def interrupt(*_: object) -> None:
    """Do what Ctrl-C does."""
    raise KeyboardInterrupt


def test_faults_of_the_data_end_with_a_sentence_and_a_report(campaign, tmp_path):
    text = (campaign / "campaign.toml").read_text(encoding="utf-8")
    assert 'unit = "mm"' in text
    (campaign / "campaign.toml").write_text(text.replace('unit = "mm"', 'unit = "m"', 1), encoding="utf-8")
    table = next(path for path in campaign.glob("*.csv") if path.name != "noise.csv")
    first, *rows = table.read_text(encoding="utf-8").splitlines()
    table.write_text("\n".join([f"{first},weather", *(f"{row},1" for row in rows)]), encoding="utf-8")
    shown = command("discrepancy", "check", str(campaign), *RIG)
    assert shown.returncode == 1
    assert "Fault:" in shown.stdout
    assert "no channel has the column 'weather'" in shown.stdout
    error = refused("discrepancy", "run", str(campaign), *RIG, "--out", str(tmp_path / "v"))
    assert "shows about 1000 times what the model predicts (mm given as m?)" in error
    assert sorted(path.name for path in (tmp_path / "v").iterdir()) == ["report.html", "verdict.json"]
    page = (tmp_path / "v" / "report.html").read_text(encoding="utf-8")
    assert "Proof" not in page
