"""`uav-twin discrepancy import` as a user calls it, with a terminal and without."""

import os
import pty
import re
import select
import shlex
import signal
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout, suppress
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest
from openpyxl import Workbook

from discrepancy.campaign.reading import read_campaign
from discrepancy.campaign.records import Campaign, Quantity, TrialKind
from discrepancy.model_choice import choose_model
from discrepancy.sources.examples import example_campaign, plan_from_scales
from discrepancy.system.response import Conditions
from fe.runtime.patch import ModelPatch
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


@pytest.fixture(scope="module")
def laboratory_campaigns(tmp_path_factory: pytest.TempPathFactory) -> tuple[Campaign, Campaign]:
    """A simulated campaign, and the one that the command imports from its files."""
    folder = tmp_path_factory.mktemp("laboratory")
    simulated = laboratory(folder)
    files = [f"{trial.name}.csv" for trial in simulated.trials]
    options: list[str] = []
    for trial in simulated.trials:
        options += ["--kind", f"{trial.name}.csv={trial.kind.value}"]
        if trial.release:
            millimetres = 1e3 * trial.release.displacement
            options += ["--release", f"{trial.name}.csv={millimetres!r}mm"]
    target = ("--out", "lab", "--load-place", "tip", "--model", MODEL)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        done = command(*IMPORT, *files, *options, *COLUMNS, *target)
        assert (done.returncode, done.stderr) == (0, "")
        return simulated, read_campaign("lab")


def test_a_folder_of_files_becomes_the_trials_of_a_campaign(laboratory_campaigns):
    simulated, imported = laboratory_campaigns
    assert [trial.name for trial in imported.trials] == [trial.name for trial in simulated.trials]
    assert [trial.kind for trial in imported.trials] == [trial.kind for trial in simulated.trials]
    assert {trial.load_place for trial in imported.trials} == {"tip"}


def test_imported_trials_have_the_values_of_their_files(laboratory_campaigns):
    simulated, imported = laboratory_campaigns
    for ours, theirs in zip(imported.trials, simulated.trials, strict=True):
        np.testing.assert_allclose(ours.values, theirs.values, rtol=1e-14)
        np.testing.assert_allclose(ours.force, theirs.force, rtol=1e-14)
        if ours.is_dynamic:
            np.testing.assert_allclose(ours.time, theirs.time, rtol=1e-14)
        if theirs.release is not None:
            assert ours.release.displacement == pytest.approx(theirs.release.displacement, rel=1e-15)


def test_an_imported_campaign_says_where_its_trials_come_from(laboratory_campaigns):
    _, imported = laboratory_campaigns
    columns = "'Zeit' [ms] is time, 'Weg' [mm] is displacement and 'Dehnung' [µm/m] is leaf_strain"
    origin = next(sentence for sentence in imported.provenance if "release 1.csv" in sentence)
    assert "Imported from release 1.csv (SHA-256 " in origin
    assert columns in origin


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


SAMPLES_AT_REST = "time [s],x [um],temperature [degC]\n" + "".join(
    f"{row / 100},{(row * 7) % 11 - 5},20\n" for row in range(40)
)
PUSH = "time [s],x [um],pull [mN],leaf_strain [mV/V],temperature [°C]\n" + "".join(
    f"{row / 100},{'' if row == 3 else row % 5},{row},{row / 8},{20 + row / 8}\n" for row in range(16)
)
PUSH_OPTIONS = (
    "--kind", "noise", "--kind", "push.csv=driven", "--column", "x=displacement", "--column",
    "pull=input:pull", "--reference-temperature", "20", "--model", MODEL, "--out", "lab",
)  # fmt: skip


@pytest.fixture
def pushed(here: Path) -> Campaign:
    """A campaign of samples at rest and a driven trial, in which one cell is empty."""
    Path("n1.csv").write_text(SAMPLES_AT_REST, "utf-8")
    Path("push.csv").write_text(PUSH, "utf-8")
    said(*IMPORT, "push.csv", "n1.csv", *PUSH_OPTIONS)
    return read_campaign("lab")


def test_samples_at_rest_of_two_files_are_refused():
    for name in ("n1.csv", "n2.csv"):
        Path(name).write_text(SAMPLES_AT_REST, "utf-8")
    Path("push.csv").write_text(PUSH, "utf-8")
    done = command(*IMPORT, "push.csv", "n1.csv", "n2.csv", *PUSH_OPTIONS)
    sentence = "Noise is read from one file, but n1.csv and n2.csv were given: give one of them."
    assert (done.returncode, done.stderr.strip()) == (1, sentence)


def test_an_import_writes_origins_and_assumptions_only(pushed):
    toml = Path("lab/campaign.toml").read_text("utf-8")
    remarks = toml.split("]\n\n[")[0]
    assert "begins" not in toml
    assert toml.count("Imported from") == len(pushed.provenance) == 2
    assert remarks.count('",\n') == 3  # two origins, and that zeros and gains were assumed


def test_an_empty_cell_is_counted(pushed):
    assert "; 1 cell is empty." in Path("lab/campaign.toml").read_text("utf-8")


def test_samples_at_rest_are_the_noise_of_their_channel(pushed):
    noise = pushed.channels["x"].noise
    assert noise.samples is not None
    assert noise.interval == pytest.approx(0.01)


def test_inputs_and_temperatures_are_imported(pushed):
    (trial,) = pushed.trials
    (pull,) = trial.inputs
    assert (pull.name, pull.values[3]) == ("pull", 3e-3)
    assert trial.temperature[8] == 1.0


def test_a_channel_in_millivolts_per_volt_is_a_signal(pushed):
    assert pushed.channels["leaf_strain"].quantity is Quantity.SIGNAL


def test_how_a_trial_begins_is_assumed_until_it_is_said(pushed):
    assumption = "(assumed; set `begins`"
    file = Path("lab/campaign.toml")
    stated = file.read_text("utf-8").replace('"driven"', '"driven"\nbegins = "still"')
    assert assumption in " ".join(pushed.remarks)
    file.write_text(stated, "utf-8")
    assert assumption not in " ".join(read_campaign("lab").remarks)


def test_a_flight_has_its_load_factor():
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


class DocumentedImport:
    """The blocks of the page on laboratory files, whose two files stand in the folder at hand."""

    def __init__(self) -> None:
        page = Path(__file__).parents[2] / "docs" / "how_to" / "laboratory_files.md"
        blocks = re.findall(r"^```\n(.*?)^```", page.read_text("utf-8"), re.MULTILINE | re.DOTALL)
        loading, release, self.asked, self.given, self.written, self.checked = blocks[:6]
        Path("loading.csv").write_text(loading, "utf-8-sig")
        Path("release.csv").write_bytes(release.encode("latin-1"))

    def documented_and_shown(self, block: str) -> tuple[list[str], list[str]]:
        """Return the screen that a block documents, and what its command shows."""
        line, _, screen = block.replace("\\\n", "").partition("\n")
        done = command(*shlex.split(line)[1:])
        return lines_with_text(screen), lines_with_text(done.stdout + done.stderr)


def lines_with_text(text: str) -> list[str]:
    return [line.rstrip() for line in text.splitlines() if line.strip()]


@pytest.mark.parametrize("block", ["asked", "given"])
def test_the_documented_files_print_the_documented_tables(block):
    page = DocumentedImport()
    documented, shown = page.documented_and_shown(getattr(page, block))
    assert documented == shown


@pytest.fixture
def documented_check(here: Path) -> tuple[DocumentedImport, subprocess.CompletedProcess[str]]:
    """The documented import, and what the check of its campaign prints."""
    page = DocumentedImport()
    page.documented_and_shown(page.given)
    return page, command("discrepancy", "check", "lab", "--model", "single_mass_rig")


def test_the_documented_import_writes_the_documented_file(documented_check):
    page, _ = documented_check
    beginning = page.written.rpartition("...")[0]
    assert Path("lab/02_release.csv").read_text("utf-8").startswith(beginning)


def test_the_documented_campaign_has_the_documented_faults(documented_check):
    page, checked = documented_check
    documented_faults = page.checked.splitlines()
    printed_text = " ".join(checked.stdout.split())  # lines are broken at the width of the terminal
    assert checked.returncode == 1
    assert printed_text.count("Fault: ") == len(documented_faults)
    assert all(fault in printed_text for fault in documented_faults)


def test_the_origin_of_a_campaign_is_in_its_file_and_not_printed(documented_check):
    _, checked = documented_check
    toml = Path("lab/campaign.toml").read_text("utf-8")
    assert len(re.findall(r"Imported from .* \(SHA-256 [0-9a-f]{64}\)", toml)) == 2
    assert "Note: At the import, zeros and gains" in checked.stdout
    assert "Imported from" not in checked.stdout


# ---------------------------------------------------------------- a terminal


def in_a_terminal(answers: list[str], *words: object) -> tuple[int, str]:
    """Return exit code and screen of the command, its questions answered one after the other."""
    screen = Terminal()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(screen), redirect_stderr(screen):
        patch.setattr(sys, "stdin", Terminal("\n".join([*answers, ""])))
        code = command_line.call(patch, *IMPORT, *words)
    return code, screen.getvalue()


def test_a_no_at_a_terminal_writes_nothing():
    Path("swing.csv").write_bytes(TWO["swing.csv"])
    answers = ["ringdown", ",", "tip", "mm", "12 mm", "", "", "n"]
    code, screen = in_a_terminal(answers, "swing.csv")
    assert code == 1, screen
    assert "Nothing was written." in screen
    assert [path.name for path in Path().iterdir()] == ["swing.csv"]


@pytest.fixture
def answered_import(here: Path) -> tuple[str, Campaign]:
    """The screen of an import whose user answers some questions wrongly first, and its campaign."""
    Path("swing.csv").write_bytes(TWO["swing.csv"])
    answers = ["swinging", "ringdown", ",", "tip", "miles per hour", "mm", "12 mm", "a bit", "0.5mm", "", "y"]
    code, screen = in_a_terminal(answers, "swing.csv", "--out", "lab")
    assert code == 0, screen
    return screen, read_campaign(here / "lab")


def test_a_terminal_is_asked_again_after_a_wrong_answer(answered_import):
    screen, _ = answered_import
    kinds = "static, ringdown, forced, driven, flight or noise"
    assert f"--kind must be {kinds}, but 'swinging' was given." in screen
    assert "--zero of 'Weg' must be a standard deviation such as 0.1mm or 1%" in screen
    assert "Write lab?" in screen


def test_answers_at_a_terminal_are_those_of_options(answered_import):
    _, imported = answered_import
    trial = imported.trials[0]
    channel = imported.channels["Weg"]
    assert (trial.values[1, 0], trial.release.displacement) == (2e-3, 0.012)
    assert channel.offset_deviation == pytest.approx(0.0005, rel=1e-12)
    assert channel.gain_deviation == 0.02


class PseudoTerminal:
    """The import as a process at a pseudo-terminal, as a user has it."""

    def __init__(self, *words: object) -> None:
        self.screen = ""
        self._read_until = 0  # the position in the screen up to which the test has read
        command_words = [sys.executable, "-m", "uav_twin", *IMPORT, *map(str, words)]
        self._process, self._terminal = pty.fork()
        if self._process == 0:
            signal.signal(signal.SIGINT, signal.SIG_DFL)  # a shell ignores it in its background
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


def answer(terminal: PseudoTerminal, *questions_and_answers: tuple[str, str]) -> None:
    """Wait for each question, and type its answer."""
    for question, reply in questions_and_answers:
        terminal.wait_for(question)
        terminal.type(reply)


class InterruptedDialogue:
    """An import that ends with Ctrl-C after three answers, and goes on with the command that it prints."""

    def __init__(self) -> None:
        Path("swing.csv").write_bytes(TWO["swing.csv"])
        first = PseudoTerminal("swing.csv", "--out", "lab")
        first.wait_for("questions to answer")
        kind = ("swing.csv: kind", "ringdown\n")
        decimal = ("swing.csv: decimal", ",\n")
        column = ("Weg: column", "tip of the wing\n")
        answer(first, kind, decimal, column, ("Weg: unit", "\x03"))  # Ctrl-C
        self.code_of_interruption = first.end()
        self.folder_was_there = Path("lab").exists()
        beginning = "Nothing was written. To go on with these answers: "
        self.words_to_go_on = printed_command(first.screen, beginning)

        second = PseudoTerminal(*self.words_to_go_on)
        self.asked_before_unit = second.wait_for("Weg: unit")
        second.type("mm\n")
        answer(second, ("swing.csv: release", "12 mm\n"))
        second.wait_for("Weg: zero")
        answer(second, ("[1%]", "0.5mm\n"), ("Weg: gain", "\n"), ("Write lab?", "y\n"))
        self.code = second.end()
        self.words_to_repeat = printed_command(second.screen, "To repeat it without questions: ")


@pytest.fixture(scope="module")
def interrupted_dialogue(tmp_path_factory: pytest.TempPathFactory) -> tuple[InterruptedDialogue, Path]:
    """The dialogue and its folder."""
    folder = tmp_path_factory.mktemp("dialogue")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        return InterruptedDialogue(), folder


def test_an_interrupted_dialogue_prints_the_command_that_goes_on(interrupted_dialogue):
    dialogue, _ = interrupted_dialogue
    assert dialogue.code_of_interruption == 130
    assert not dialogue.folder_was_there
    assert dialogue.words_to_go_on[:3] == ["swing.csv", "--out", "lab"]


def test_a_dialogue_that_goes_on_does_not_ask_again_what_was_answered(interrupted_dialogue):
    dialogue, _ = interrupted_dialogue
    assert "kind," not in dialogue.asked_before_unit
    assert dialogue.code == 0


def test_a_dialogue_that_goes_on_writes_what_was_answered_before_and_after(interrupted_dialogue):
    _, folder = interrupted_dialogue
    channels = read_campaign(folder / "lab").channels
    assert [channel.output for channel in channels.values()] == ["tip of the wing"]
    assert channels["Weg"].offset_deviation == pytest.approx(0.0005, rel=1e-12)


def test_the_command_that_a_dialogue_prints_repeats_it_without_questions(interrupted_dialogue, monkeypatch):
    dialogue, folder = interrupted_dialogue
    monkeypatch.chdir(folder)
    words = ["again" if word == "lab" else word for word in dialogue.words_to_repeat]
    code, screen = in_a_terminal([], *words)  # a terminal without a user
    expected = Path("lab/campaign.toml").read_bytes().replace(b'"lab"', b'"again"')
    assert code == 0, screen
    assert Path("again/campaign.toml").read_bytes() == expected


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


ASSUMED_ZEROS_AND_GAINS = (
    "At the import, zeros and gains without a stated standard deviation were assumed to be known: "
    "the zero of 'x' to 0.2 um and the gain of 'x' to 2 %."
)


def test_zeros_and_gains_that_nobody_states_are_not_exact():
    swings("a.csv")
    said(*IMPORT, "a.csv", "--kind", "driven", *PLAIN)
    channel = read_campaign("a").channels["x"]
    assert channel.offset_deviation == pytest.approx(2e-7, rel=1e-12)
    assert channel.gain_deviation == 0.02


def test_assumed_zeros_and_gains_are_printed_and_remarked():
    swings("a.csv")
    printed = said(*IMPORT, "a.csv", "--kind", "driven", *PLAIN)
    assert ASSUMED_ZEROS_AND_GAINS in " ".join(printed.split())
    assert ASSUMED_ZEROS_AND_GAINS in read_campaign("a").remarks


@pytest.mark.parametrize(
    ("zero", "gain", "known"),
    [
        ("exact", "exact", (0.0, 0.0)),
        ("free", "0.5%", (np.inf, 0.005)),
        ("x=0.001mm", "x=0.03", (1e-6, 0.03)),
        ("3um", "x=exact", (3e-6, 0.0)),
    ],
)
def test_zeros_and_gains_are_as_stated(zero, gain, known):
    swings("a.csv")
    printed = said(*IMPORT, "a.csv", "--kind", "driven", *PLAIN, "--zero", zero, "--gain", gain)
    channel = read_campaign("a").channels["x"]
    assert (channel.offset_deviation, channel.gain_deviation) == pytest.approx(known, rel=1e-12)
    assert "assumed" not in printed


def test_a_stated_release_and_zero_keep_their_digits():
    swings("a.csv")
    said(*IMPORT, "a.csv", "--kind", "ringdown", *PLAIN, "--release", "85µm", "--zero", "x=85 um")
    campaign = read_campaign("a")
    assert (campaign.trials[0].release.displacement, campaign.channels["x"].offset_deviation) == (
        85e-6,
        85e-6,
    )


CUT_OFF = ("--kind", "ringdown", *COLUMNS[:2], "--release", "600N")


def swing_from(first_time: float) -> None:
    """Write a record of 100 samples of a ring-down."""
    rows = "".join(f"{first_time + 0.01 * row:.2f},{row % 7}\n" for row in range(100))
    Path("cut.csv").write_text(f"t [s],Weg [mm]\n{rows}", "utf-8")


def response_of_rig(campaign: Campaign) -> np.ndarray:
    """Return the displacement [m] that the rig has at the readings of the only trial."""
    model = choose_model(MODEL).model
    outputs = (("displacement", Quantity.DISPLACEMENT),)
    conditions = Conditions(model.prior_mean())
    (trial,) = campaign.trials
    return model.respond(trial, outputs, ModelPatch(), conditions).values[trial.used[:, 0], 0]


@pytest.mark.parametrize("release", ["600N", "0.6kN", "-600 N"])
def test_a_release_by_a_force_is_one_from_the_deflection_under_it(release):
    swing_from(0.0)
    given = ("--kind", "ringdown", *COLUMNS[:2], "--load-place", "tip", *RIG, "--ask-nothing")

    said(*IMPORT, "cut.csv", *given, "--release", release, "--out", "by_force")

    cut = response_of_rig(read_campaign("by_force"))
    said(*IMPORT, "cut.csv", *given, "--release", f"{cut[0]}m", "--out", "by_displacement")
    held = response_of_rig(read_campaign("by_displacement"))
    assert np.sign(cut[0]) == (-1.0 if release.startswith("-") else 1.0)
    np.testing.assert_allclose(cut, held, rtol=0.0, atol=1e-9 * abs(cut[0]))


def test_a_deflection_under_a_release_force_is_that_of_a_static_trial():
    swing_from(0.0)
    Path("pull.csv").write_text("F [N],Weg [mm]\n600,1\n", "utf-8")
    given = (*COLUMNS[:2], "--load-place", "tip", *RIG, "--ask-nothing")
    said(*IMPORT, "cut.csv", "--kind", "ringdown", *given, "--release", "600N", "--out", "cut")
    said(*IMPORT, "pull.csv", "--kind", "static", *given, "--out", "pull")
    cut, pull = response_of_rig(read_campaign("cut")), response_of_rig(read_campaign("pull"))
    assert cut[0] == pytest.approx(pull[0], rel=1e-12)


def test_a_record_that_begins_before_the_force_is_cut_off_shows_when():
    swing_from(-0.02)
    said(*IMPORT, "cut.csv", *CUT_OFF, "--out", "cut")
    (trial,) = read_campaign("cut").trials
    assert (trial.begins.value, trial.force.tolist()) == ("settled", [600.0, 600.0, *[0.0] * 98])


def test_a_record_that_begins_after_the_force_is_cut_off_is_refused():
    Path("cut.csv").write_text("t [s],Weg [mm]\n5,5\n5.01,4\n5.02,4\n", "utf-8")
    done = command(
        *IMPORT, "cut.csv", "--kind", "ringdown", *COLUMNS[:2], "--release", "600N", "--out", "cut"
    )
    sentence = "cut.csv: the time begins at 5 s, and a release by a force is at 0: count times from there."
    assert (done.returncode, done.stderr.strip(), Path("cut").exists()) == (1, sentence, False)


def test_holds_begins_and_files_for_proof_are_written():
    swings("a.csv", "b.csv")
    columns = ("--kind", "driven", "--column", "x=x", "--column", "U=input:U", "--quantity", "U=voltage")
    begins = ("--begins", "a.csv=still", "--begins", "b.csv=unknown")
    said(*IMPORT, "a.csv", "b.csv", *columns, *begins, "--hold", "U=zero_order", "--held-out", "b.csv")
    first, second = read_campaign("a").trials
    assert (first.begins.value, first.held_out) == ("still", False)
    assert (second.begins.value, second.held_out) == ("unknown", True)
    assert [item.hold.value for item in first.inputs] == ["zero_order"]


def test_a_zero_without_a_unit_is_refused():
    swings("a.csv")
    sentence = refused(*IMPORT, "a.csv", "--kind", "driven", *PLAIN, "--zero", "3")
    assert "--zero of 'x' needs a unit, such as 3" in sentence


def test_a_table_without_a_time_has_the_interval_that_is_stated():
    swings("a.csv", first_column=False)
    command = (*IMPORT, "a.csv", "--kind", "driven", *PLAIN)
    sentence = refused(*command)
    said(*command, "--interval", "0.02")
    assert "--interval NAME=... for 'a.csv' (seconds between its rows" in sentence
    assert read_campaign("a").trials[0].time.tolist() == [0.02 * k for k in range(16)]


def test_an_interval_for_a_table_with_a_time_is_refused():
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


POUND = 4.4482216152605
"""Newtons of a pound of force."""


@pytest.fixture
def push_in_pounds(here: Path) -> tuple[str, ...]:
    """The beginning of a command that imports a file whose pull is in pounds."""
    rows = "".join(f"{row / 100},{row},{row % 3}\n" for row in range(9))
    Path("push.csv").write_text(f"time [s],pull [lbf],x [in]\n{rows}", "utf-8")
    return (*IMPORT, "push.csv", "--column", "x=x")


def check_pull_in_pounds(folder: str, column: str) -> None:
    """Check that the file of a trial has its pull in pounds, and the campaign in newtons."""
    header, _, third_line, *_ = Path(folder, "01_push.csv").read_text("utf-8").splitlines()
    (trial,) = read_campaign(folder).trials
    assert (header, third_line) == (f"time,{column},x", "0.01,1.0,1.0")
    np.testing.assert_allclose(trial.force, POUND * np.arange(9.0), rtol=1e-14)


def test_an_input_keeps_the_unit_of_its_file(push_in_pounds):
    """The unit stands in `[[input]]`."""
    options = ("--kind", "driven", "--column", "pull=input:pull", "--zero", "pull=0.5lbf")
    said(*push_in_pounds, *options, "--out", "driven")
    (pull,) = read_campaign("driven").trials[0].inputs
    check_pull_in_pounds("driven", "pull")
    assert (pull.unit, pull.offset_deviation) == ("lbf", pytest.approx(0.5 * POUND, rel=1e-14))


def test_the_force_of_a_forced_trial_keeps_the_unit_of_its_file(push_in_pounds):
    """The unit stands in `force_unit`."""
    said(*push_in_pounds, "--kind", "forced", "--column", "pull=force", "--out", "forced")
    check_pull_in_pounds("forced", "force")
    assert 'force_unit = "lbf"' in Path("forced/campaign.toml").read_text("utf-8")


def test_a_force_in_a_unit_of_length_is_refused(push_in_pounds):
    said(*push_in_pounds, "--kind", "forced", "--column", "pull=force", "--out", "forced")
    file = Path("forced/campaign.toml")
    file.write_text(file.read_text("utf-8").replace('"lbf"', '"mm"'), "utf-8")
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


OUTPUTS_OF_RIG = "displacement (displacement in m) and leaf_strain (strain without a unit)"
ONE_SWING = ("swing.csv", "--kind", "ringdown", "--release", "8mm", "--decimal", ",", "--model", MODEL)


@pytest.fixture
def one_swing():
    Path("swing.csv").write_bytes(TWO["swing.csv"])


@pytest.mark.usefixtures("one_swing")
def test_the_outputs_of_the_model_are_listed_where_a_column_may_be_one_of_them():
    assert f"The model has the outputs {OUTPUTS_OF_RIG}." in refused(*IMPORT, *ONE_SWING)


@pytest.mark.usefixtures("one_swing")
def test_the_outputs_of_the_model_are_listed_where_a_column_is_said_to_be_another():
    wrong = ("--column", "Weg=deflection", "--unit", "Weg=mm")
    sentence = refused(*IMPORT, *ONE_SWING, *wrong)
    assert f"the model has no output 'deflection'; it has {OUTPUTS_OF_RIG}; choose another." in sentence


@pytest.mark.usefixtures("one_swing")
def test_a_dialogue_lists_the_outputs_of_the_model_before_it_asks_for_one():
    answers = ["deflection", "displacement", "mm", "", "", "y"]
    _, screen = in_a_terminal(answers, *ONE_SWING, "--out", "lab")
    channels = read_campaign("lab").channels.values()
    assert screen.index(f"The model has the outputs {OUTPUTS_OF_RIG}.") < screen.index("Weg: column")
    assert [channel.output for channel in channels] == ["displacement"]


PULL_WITH_WILD_READING = "F [N],w [mm]\n0,0\n1,1\n2,2\n3,3\n4,4321\n"
PULL = ("pull.csv", "--kind", "static", "--column", "w=displacement", "--ask-nothing", "--out", "lab")


def test_a_wild_reading_does_not_set_the_default_of_its_zero():
    Path("pull.csv").write_text(PULL_WITH_WILD_READING, encoding="utf-8")

    text = said(*IMPORT, *PULL)

    assert "the zero of 'w' to 0.03 mm" in text
    assert "no other reading supports 4321 in line 6 of 'w'" in text


def test_a_load_place_that_the_model_does_not_have_is_refused_at_import():
    Path("pull.csv").write_text(PULL_WITH_WILD_READING, encoding="utf-8")

    sentence = refused(*IMPORT, *PULL, *RIG, "--load-place", "mass")

    assert "the load place is 'mass'" in sentence
    assert "takes forces at tip" in sentence
    assert not Path("lab").exists()


def test_each_sheet_of_a_workbook_is_a_trial_of_its_name():
    book = Workbook()
    for title in ("Zug", "Schwingung 1.5mm"):
        sheet = book.create_sheet(title)
        sheet.append(["t [s]", "x [mm]"])
        for row in range(40):
            sheet.append([0.01 * row, row % 7])
    book.save("lab.xlsx")
    kinds = ("--kind", "driven", "--kind", "lab.xlsx#Schwingung 1.5mm=ringdown", "--release", "1.5mm")
    said(*IMPORT, "lab.xlsx#all", *kinds, "--column", "x=x")
    trials = read_campaign("lab").trials
    assert [(trial.name, trial.kind.value) for trial in trials] == [
        ("Zug", "driven"), ("Schwingung 1.5mm", "ringdown"),
    ]  # fmt: skip


def test_replace_writes_the_import_anew():
    Path("pull.csv").write_text(PULL_WITH_WILD_READING, encoding="utf-8")
    said(*IMPORT, *PULL)
    Path("pull.csv").write_text(PULL_WITH_WILD_READING.replace("4321", "4.5"), encoding="utf-8")

    said(*IMPORT, *PULL, "--replace")

    assert read_campaign("lab").trials[0].values[-1, 0] == pytest.approx(4.5e-3, rel=1e-14)


def test_replace_leaves_a_folder_with_other_files_unchanged():
    Path("pull.csv").write_text(PULL_WITH_WILD_READING, encoding="utf-8")
    said(*IMPORT, *PULL)
    Path("lab", "notes.txt").write_text("mine", encoding="utf-8")

    sentence = refused(*IMPORT, *PULL, "--replace")

    assert "notes.txt" in sentence
    assert Path("lab", "notes.txt").read_text(encoding="utf-8") == "mine"
