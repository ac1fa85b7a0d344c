"""A run of the benchmarks: its lines, its record, its comparison with an earlier run, and failures."""

import json
import os
import sys
from pathlib import Path

import pytest

from benchmarks import __main__ as command
from benchmarks.__main__ import BenchmarkRun, last_record_file, main
from benchmarks.comparison import change_since
from benchmarks.lines import figure_text, line, target_text
from benchmarks.measurement import (
    DisagreementError,
    Measurement,
    NotAvailableError,
    compared,
    run_command,
)
from benchmarks.peer_networks import PEER_PYTHON, python_with_dynamax
from benchmarks.record import BenchmarkRecord, Row, read_record, this_machine, write_record

ROOT = Path(__file__).parents[2]


def record_of(*measurements: Measurement, benchmark: str = "wing", version: str = "1.0") -> BenchmarkRecord:
    rows = tuple(Row(benchmark=benchmark, measurement=measurement) for measurement in measurements)
    return BenchmarkRecord(version=version, date="2026-11-28", machine=this_machine(), rows=rows)


STEP = Measurement("a step", 2.0, "ms", 3.0, "fmpy", 4.0, peer="FMPy 0.3")
SPEED_UP = Measurement("speed-up", 10.0, "x", 5.0, larger_is_better=True)


def test_a_record_that_was_written_is_read_as_it_was(tmp_path):
    agreement = compared("strains", [1.0, 2.0], [1.0, 2.0 + 2e-9], 1e-6)
    record = record_of(STEP, Measurement("strain", 1.0, "us", agreement=agreement))
    write_record(tmp_path / "record.json", record)
    assert read_record(tmp_path / "record.json") == record


def test_a_record_names_version_date_and_processor_and_no_folder(tmp_path):
    write_record(tmp_path / "record.json", record_of(STEP))
    text = (tmp_path / "record.json").read_text(encoding="utf-8")
    content = json.loads(text)
    assert {"version", "date", "machine", "rows"} <= set(content)
    assert content["machine"]["processor"]
    assert not [folder for folder in (str(Path.home()), str(ROOT)) if folder in text]


@pytest.mark.parametrize(
    ("content", "words"),
    [("{", "JSON"), ('{"version": "1"}', "not a record of benchmarks"), ("[]", "the whole file")],
)
def test_what_is_not_a_record_is_refused_with_its_reason(content, words, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    file = tmp_path / "record.json"
    file.write_text(content, encoding="utf-8")
    assert main(["coupling", "--compare", str(file)]) == 2
    message = capsys.readouterr().err
    assert words in message
    assert str(file) in message


@pytest.mark.parametrize(("now", "is_worse"), [(2.09, False), (2.11, True), (1.0, False)])
def test_a_time_is_worse_if_it_grows_by_more_than_a_twentieth(now, is_worse):
    change = change_since(STEP, Measurement("a step", now, "ms"))
    assert change is not None
    assert change.is_worse is is_worse
    assert change.relative == pytest.approx(now / 2.0 - 1.0, rel=1e-12)


@pytest.mark.parametrize(("now", "is_worse"), [(9.6, False), (9.5, True), (20.0, False)])
def test_a_speed_up_is_worse_if_the_earlier_one_is_larger_by_more_than_a_twentieth(now, is_worse):
    change = change_since(SPEED_UP, Measurement("speed-up", now, "x", larger_is_better=True))
    assert change is not None
    assert change.is_worse is is_worse


@pytest.mark.parametrize("before", [None, Measurement("a step", 2.0, "s"), Measurement("a step", 0.0, "ms")])
def test_without_an_earlier_figure_of_the_same_unit_there_is_no_change(before):
    assert change_since(before, STEP) is None


def test_a_later_run_of_one_benchmark_leaves_the_rows_of_the_others():
    earlier = record_of(STEP).model_copy(update={"rows": record_of(STEP).rows + rows_of_tank()})
    later = record_of(Measurement("a step", 1.0, "ms"), version="2.0")
    updated = earlier.updated_by(later)
    assert updated.version == "2.0"
    assert updated.by_key()["wing", "a step"].value == 1.0
    assert updated.by_key()["tank", "speed-up"] == SPEED_UP


def rows_of_tank() -> tuple[Row, ...]:
    return record_of(SPEED_UP, benchmark="tank").rows


def test_a_line_says_figure_target_ratio_change_and_peer():
    text = line(STEP, change_since(Measurement("a step", 1.6, "ms"), STEP))
    assert text.split("  ")[0] == "a step"
    assert text.split()[2:10] == ["2", "ms", "≤", "3", "ms", "yes", "0.5", "+25"]
    assert text.endswith("fmpy: 4 ms; FMPy 0.3")


def test_answers_that_differ_by_more_than_the_tolerance_are_an_error():
    with pytest.raises(DisagreementError, match=r"^beliefs differ by 0\.5 of the largest value .* 0\.1\.$"):
        compared("beliefs", [1.0, 1.0], [1.0, 2.0], 0.1)
    with pytest.raises(DisagreementError, match="nan"):
        compared("beliefs", [float("nan")], [1.0], 0.1)


def test_a_figure_is_a_finite_number():
    with pytest.raises(ValueError, match="'a step' is nan"):
        Measurement("a step", float("nan"), "ms")


def failing():
    yield STEP
    raise RuntimeError("The mesh\nhas no cells.")


def unavailable():
    raise NotAvailableError("CalculiX is not installed.")


def sound():
    yield Measurement("a step", 3.0, "ms", 2.0)


def test_a_benchmark_that_fails_says_its_sentence_and_the_others_go_on(capsys):
    run = BenchmarkRun(record_of(STEP))
    for name, benchmark in (("wing", failing), ("mesh", unavailable), ("tank", sound)):
        run.measure(name, lambda benchmark=benchmark: benchmark)
    printed = capsys.readouterr().out
    assert "wing: FAILED: RuntimeError: The mesh has no cells.\n" in printed
    assert "mesh: left out: CalculiX is not installed.\n" in printed
    assert [row.key for row in run.rows] == [("wing", "a step"), ("tank", "a step")]


def with_benchmarks(monkeypatch, tmp_path, **benchmarks):
    """Run the command line with other benchmarks."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(command, "benchmark_names", lambda: [*benchmarks])
    monkeypatch.setattr(command, "load_benchmark", lambda name: benchmarks[name])


@pytest.mark.parametrize(
    ("benchmarks", "options", "code"),
    [
        ({"tank": sound}, [], 0),
        ({"tank": sound}, ["--strict"], 1),
        ({"mesh": unavailable}, ["--strict"], 0),
        ({"wing": failing, "tank": sound}, [], 1),
        ({"tank": sound}, ["ship"], 2),
    ],
    ids=["sound", "a target is missed", "not installed", "failing", "unknown name"],
)
def test_the_exit_code_tells_failures(benchmarks, options, code, monkeypatch, tmp_path):
    with_benchmarks(monkeypatch, tmp_path, **benchmarks)
    assert main(options) == code


@pytest.mark.parametrize(
    ("words", "chosen"),
    [
        ([], ["compiled_fmu", "fmu", "tank"]),
        (["fmu"], ["fmu"]),
        (["fm", "tank"], ["compiled_fmu", "fmu", "tank"]),
    ],
    ids=["none", "a name", "parts of names"],
)
def test_words_choose_a_benchmark_of_this_name_or_those_that_contain_them(words, chosen, monkeypatch):
    monkeypatch.setattr(command, "benchmark_names", lambda: ["compiled_fmu", "fmu", "tank"])
    assert command.chosen_benchmarks(words) == chosen


def test_a_run_is_compared_with_the_last_one(monkeypatch, tmp_path, capsys):
    with_benchmarks(monkeypatch, tmp_path, tank=lambda: [STEP])
    assert main([]) == 0
    with_benchmarks(monkeypatch, tmp_path, tank=sound)
    assert main([]) == 0
    assert "1 of 1 figure worse by more than 5 %:\n  a step: 2 ms before, 3 ms now (+50 %)" in (
        capsys.readouterr().out
    )


def test_a_last_run_that_cannot_be_read_is_told_and_replaced(monkeypatch, tmp_path, capsys):
    with_benchmarks(monkeypatch, tmp_path, tank=sound)
    last_record_file().parent.mkdir()
    last_record_file().write_text("{", encoding="utf-8")
    assert main([]) == 0
    assert "not compared with the last one" in capsys.readouterr().err
    assert len(read_record(last_record_file()).rows) == 1


def test_a_record_that_cannot_be_written_is_told(monkeypatch, tmp_path, capsys):
    with_benchmarks(monkeypatch, tmp_path, tank=sound)
    (tmp_path / "file").touch()
    assert main(["--json", str(tmp_path / "file" / "record.json")]) == 2
    assert "record.json" in capsys.readouterr().err


def test_an_interpreter_that_does_not_exist_is_refused(monkeypatch, tmp_path, capsys):
    with_benchmarks(monkeypatch, tmp_path, tank=sound)
    assert main(["--peer-python", str(tmp_path / "python")]) == 2
    assert "is not a program" in capsys.readouterr().err


def interrupted():
    raise KeyboardInterrupt


def test_an_interrupted_run_keeps_the_figures_of_the_benchmarks_before(monkeypatch, tmp_path):
    with_benchmarks(monkeypatch, tmp_path, tank=sound, wing=interrupted)
    assert main(["--json", str(tmp_path / "record.json")]) == 130
    assert [row.key for row in read_record(tmp_path / "record.json").rows] == [("tank", "a step")]
    assert [row.key for row in read_record(last_record_file()).rows] == [("tank", "a step")]


@pytest.mark.parametrize(
    ("figure", "text"),
    [
        (Measurement("a", 3289.4, "us", 5.0), "3289 µs ≤ 5 µs"),
        (Measurement("a", 1e-4, "1", 1e-3), "0.0001 ≤ 0.001"),
        (Measurement("a", 3.0, "x", 2.0, larger_is_better=True), "3 x ≥ 2 x"),
    ],
    ids=["time", "pure number", "speed-up"],
)
def test_figure_and_target_stand_with_their_unit(figure, text):
    assert f"{figure_text(figure)} {target_text(figure)}" == text


def test_without_dynamax_a_figure_stands_alone_and_says_how_to_install_it(monkeypatch):
    monkeypatch.delenv(PEER_PYTHON, raising=False)
    monkeypatch.setattr("benchmarks.peer_networks.find_spec", lambda name: None)
    with pytest.raises(NotAvailableError, match="peers/bin/pip install dynamax"):
        python_with_dynamax()
    figure = Measurement("smooth", 2.0, "ms", peer="dynamax", remark="dynamax is not installed")
    assert line(figure, None).endswith("dynamax; dynamax is not installed")


def test_the_processor_time_of_a_command_counts_the_processes_that_it_starts(tmp_path):
    """The inner process states its own time before it ends, so that the whole is at least that."""
    stated = tmp_path / "seconds.txt"
    inner = f"""
import pathlib, time
sum(range(10**6))
pathlib.Path({str(stated)!r}).write_text(str(time.process_time()))
"""
    outer = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {inner!r}], check=True)"
    measured = run_command([sys.executable, "-c", outer], os.environ)
    assert measured.processor_seconds >= float(stated.read_text())


def test_a_command_that_fails_is_told_with_its_last_line():
    code = "print('before'); raise SystemExit('The mesh is missing.')"
    with pytest.raises(RuntimeError, match=r"exit code 1: The mesh is missing\.$"):
        run_command([sys.executable, "-c", code], os.environ)
