"""The page of measured figures, from the record of a run.

``python -m benchmarks.benchmark_page`` writes it anew from ``benchmarks/published.json``, which
``python -m benchmarks --json benchmarks/published.json`` measures.
"""

import ast
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path

from benchmarks.comparison import NOTEWORTHY
from benchmarks.lines import agreement_text, figure_text, peer_text, target_text, with_unit
from benchmarks.measurement import Measurement
from benchmarks.record import BenchmarkRecord, Row, read_record
from reporting.files import atomic_write_text
from reporting.words import comma_list, counted, significant

PAGE = Path(__file__).parents[1] / "docs" / "reference" / "benchmarks.md"
PUBLISHED = Path(__file__).with_name("published.json")
_INTRODUCTION = """\
<!-- Written by `python -m benchmarks.benchmark_page` from `benchmarks/published.json`. -->
# Measured times and errors

**How long does each computation take, and how long does another program take for the same
problem?** This page lists the figures of `make bench`, each with its target and with what ran
beside it in the same run; what was not run stands at the end.
[Benchmarks](../explanation/benchmarks.md) says what the figures mean for a user, and how reliably
the twin steers.

{circumstances}

In all tables, *ratio* is the measured figure over the one beside it. A ratio does not depend on the
speed of the machine, a time does. A figure in bold misses its target.

## Measure again

`make bench`, or `python -m benchmarks` in the environment of `make setup`, prints each figure when
it is measured.

| command | what it does |
| --- | --- |
| `python -m benchmarks --list` | prints the names of the benchmarks |
| `python -m benchmarks NAME ...` | runs those whose name contains NAME |
| `python -m benchmarks --json FILE` | writes a record: version, date, processor, all figures |
| `python -m benchmarks --compare FILE` | compares with the record of FILE, not the last run |
| `python -m benchmarks --strict` | exits with code 1 also if a target is missed |
| `python -m benchmarks.benchmark_page` | writes this page from `benchmarks/published.json` |

Each figure is compared with that of the last run, and the figures that have become worse by more
than {noteworthy:.0f} % are listed at the end. On a machine that does other work, changes of this
size are common: repeat the benchmark before you look for a cause. The record of the last run is
`uav-twin/benchmarks.json` in the cache folder (`$XDG_CACHE_HOME`, or `~/.cache`). A benchmark that
fails says so in one sentence, the others go on, and the exit code is 1.

A peer that `make setup` does not install is given by an environment of its own:

```
python3 -m venv peers && peers/bin/pip install dynamax
python -m benchmarks twin --peer-python peers/bin/python
```

## Beside other programs

Both programs solve the same problem and are warmed before they are timed; the least of several
times counts. Runs of CalculiX are whole processes, with reading and printing. The last column says
how far the answers differ, relative to the largest value, and which difference is accepted. A
larger difference is an error of the benchmark.

"""


def page(record: BenchmarkRecord) -> str:
    """Return the text of the page."""
    beside_peers = [row.measurement for row in record.rows if row.measurement.peer]
    parts = [
        _INTRODUCTION.format(circumstances=_circumstances(record), noteworthy=100 * NOTEWORTHY),
        "| what | uav-twin | peer | ratio | agreement |\n| --- | --- | --- | --- | --- |\n",
        *(_row_beside_peer(measurement) for measurement in beside_peers),
        "\n## All figures\n",
    ]
    for benchmark, rows in groupby(record.rows, key=_benchmark_of):
        parts.append(f"\n### {benchmark}\n\n{_purpose(benchmark)}\n\n")
        parts.append("| what | measured | target | beside it | ratio |\n")
        parts.append("| --- | --- | --- | --- | --- |\n")
        parts += (_row(row.measurement) for row in rows)
    return "".join(parts) + "".join(_unmeasured(record))


def _benchmark_of(row: Row) -> str:
    return row.benchmark


def _circumstances(record: BenchmarkRecord) -> str:
    """Return version, date and machine in words."""
    machine = record.machine
    packages = comma_list(f"{name} {version}" for name, version in machine.packages.items())
    text = (
        f"The figures are those of version {record.version}, measured on {record.date} on "
        f"{counted(machine.cores, 'core')} of the processor {machine.processor} "
        f"({machine.system}), with Python {machine.python}, {packages}."
    )
    return f"{text} {record.remark}".rstrip()


def _purpose(benchmark: str) -> str:
    """Return the first line of the docstring of a benchmark."""
    source = Path(__file__).with_name(f"bench_{benchmark}.py").read_text(encoding="utf-8")
    docstring = ast.get_docstring(ast.parse(source)) or ""
    return docstring.partition("\n\n")[0].replace("\n", " ")


def _row_beside_peer(measurement: Measurement) -> str:
    """Return the row of a figure beside that of another program."""
    reference = measurement.reference_value
    theirs = "not measured"
    if reference is not None:
        theirs = with_unit(reference, measurement)
    method = f"{measurement.reference_name}, " if measurement.reference_name else ""
    cells = [
        measurement.name,
        _figure(measurement),
        f"{method}{measurement.peer}: {theirs}",
        _ratio(measurement),
        agreement_text(measurement),
    ]
    return _table_row(cells)


def _row(measurement: Measurement) -> str:
    """Return the row of a figure."""
    cells = [
        measurement.name,
        _figure(measurement),
        target_text(measurement),
        peer_text(measurement),
        _ratio(measurement),
    ]
    return _table_row(cells)


def _figure(measurement: Measurement) -> str:
    text = figure_text(measurement)
    return f"**{text}**" if measurement.reached is False else text


def _ratio(measurement: Measurement) -> str:
    return "" if measurement.ratio is None else significant(measurement.ratio)


def _table_row(cells: list[str]) -> str:
    return f"| {' | '.join(cell.replace('|', '&#124;') for cell in cells)} |\n"


def _unmeasured(record: BenchmarkRecord) -> Iterator[str]:
    """Yield the lines on benchmarks that did not run to their end."""
    if record.unmeasured:
        yield "\n## Not measured\n\n"
    for entry in record.unmeasured:
        yield f"- {entry.benchmark}: {entry.sentence}\n"


if __name__ == "__main__":
    atomic_write_text(PAGE, page(read_record(PUBLISHED)))
