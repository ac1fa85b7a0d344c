"""The page of measured figures is that of the published record, and says what a record says."""

from benchmarks import __main__ as command
from benchmarks import benchmark_page
from benchmarks.__main__ import BenchmarkRun
from benchmarks.measurement import Measurement, NotAvailableError
from benchmarks.record import read_record


def test_the_page_is_that_of_the_published_record():
    """If this fails: python -m benchmarks.benchmark_page."""
    record = read_record(benchmark_page.PUBLISHED)
    assert benchmark_page.PAGE.read_text(encoding="utf-8") == benchmark_page.page(record)


def test_the_published_record_has_every_benchmark_or_says_why_not():
    record = read_record(benchmark_page.PUBLISHED)
    measured = {row.benchmark for row in record.rows}
    assert measured | {entry.benchmark for entry in record.unmeasured} == {*command.benchmark_names()}
    assert not any(entry.failed for entry in record.unmeasured)


def test_each_published_figure_has_a_name_of_its_own_in_its_benchmark():
    record = read_record(benchmark_page.PUBLISHED)
    assert len(record.by_key()) == len(record.rows)


def missing_its_target():
    yield Measurement("a step", 3.0, "ms", 2.0)


def unavailable():
    raise NotAvailableError("CalculiX is not installed.")


def test_the_page_marks_missed_targets_and_says_what_was_not_measured():
    run = BenchmarkRun(None)
    run.measure("twin", lambda: missing_its_target)
    run.measure("solver", lambda: unavailable)
    text = benchmark_page.page(run.record("The machine did other work."))
    assert "| a step | **3 ms** | ≤ 2 ms |  |  |" in text
    assert "- solver: CalculiX is not installed." in text
    assert "The machine did other work." in text
