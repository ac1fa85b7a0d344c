"""Measure speed, memory and errors, beside other programs: `python -m benchmarks [NAME ...]`.

Each figure is printed when it is measured. A run is compared with the last one, whose record lies
in the cache folder, or with the record of `--compare FILE`.
"""

import argparse
import os
import pkgutil
import shutil
import sys
import traceback
from collections.abc import Callable, Sequence
from datetime import date
from functools import partial
from importlib import metadata
from pathlib import Path

import benchmarks
from benchmarks import lines
from benchmarks.comparison import NOTEWORTHY, Change, change_since
from benchmarks.measurement import Measurement, NotAvailableError
from benchmarks.own_process import Benchmark, figures_of_own_process, imported_benchmark
from benchmarks.peer_networks import PEER_PYTHON
from benchmarks.record import (
    BenchmarkRecord,
    BenchmarkRecordError,
    Row,
    Unmeasured,
    read_record,
    this_machine,
    write_record,
)
from fe.reduction.built_once import cache_folder
from reporting.errors import FileNotWrittenError
from reporting.words import counted, in_one_line

_PREFIX = "bench_"


class BenchmarkRun:
    """A run of benchmarks that prints each figure as it comes.

    Parameters
    ----------
    earlier : BenchmarkRecord or None
        The run that the figures are compared with.
    show_traceback : bool
        Whether the place in the code is printed where a benchmark fails.

    Attributes
    ----------
    rows : list of Row
        The figures so far.
    unmeasured : list of Unmeasured
        The benchmarks that did not run to their end.
    changes : list of Change
        The changes of the figures that the earlier run has, too.
    """

    def __init__(self, earlier: BenchmarkRecord | None, *, show_traceback: bool = False) -> None:
        self.rows: list[Row] = []
        self.unmeasured: list[Unmeasured] = []
        self.changes: list[Change] = []
        self._earlier = {} if earlier is None else earlier.by_key()
        self._show_traceback = show_traceback

    def measure(self, name: str, load: Callable[[], Benchmark]) -> None:
        """Run a benchmark; if it fails, its sentence is printed and the run goes on.

        Parameters
        ----------
        name : str
            The name of the benchmark.
        load : callable
            Imports the benchmark and returns it.
        """
        try:
            for measurement in load()():
                self._add(Row(benchmark=name, measurement=measurement))
        except NotAvailableError as error:
            self._leave_out(name, str(error), failed=False)
        except Exception as error:  # noqa: BLE001 - whatever fails, the other benchmarks go on
            text = in_one_line(str(error))
            self._leave_out(
                name, f"{type(error).__name__}: {text}" if text else repr(error), failed=True
            )
            if self._show_traceback:
                print(traceback.format_exc())

    def _add(self, row: Row) -> None:
        change = change_since(self._earlier.get(row.key), row.measurement)
        self.rows.append(row)
        if change is not None:
            self.changes.append(change)
        print(lines.line(row.measurement, change), flush=True)

    def _leave_out(self, name: str, sentence: str, *, failed: bool) -> None:
        self.unmeasured.append(Unmeasured(benchmark=name, sentence=sentence, failed=failed))
        print(f"{name}: {'FAILED' if failed else 'left out'}: {sentence}", flush=True)

    @property
    def has_failed(self) -> bool:
        """Whether a benchmark has failed."""
        return any(entry.failed for entry in self.unmeasured)

    @property
    def missed(self) -> list[Measurement]:
        """The figures that miss their targets."""
        return [row.measurement for row in self.rows if row.measurement.reached is False]

    def record(self, remark: str) -> BenchmarkRecord:
        """Return the record of the run, under a remark on its circumstances."""
        return BenchmarkRecord(
            version=metadata.version("uav-twin"),
            date=date.today().isoformat(),
            machine=this_machine(),
            remark=remark,
            rows=tuple(self.rows),
            unmeasured=tuple(self.unmeasured),
        )

    def summary(self) -> list[str]:
        """Return the closing lines: failures, missed targets, and what has become worse."""
        closing = [
            f"failed: {entry.benchmark}: {entry.sentence}"
            for entry in self.unmeasured
            if entry.failed
        ]
        missed = self.missed
        closing.append(f"{counted(len(missed), 'target')} missed{':' if missed else ''}")
        closing += [
            f"  {figure.name}: {lines.figure_text(figure)}, target {lines.target_text(figure)}"
            for figure in missed
        ]
        worse = [change for change in self.changes if change.is_worse]
        if self.changes:
            closing.append(
                f"{len(worse)} of {counted(len(self.changes), 'figure')} worse by more than "
                f"{100 * NOTEWORTHY:.0f} %{':' if worse else ''}"
            )
        return [*closing, *(f"  {change.sentence}" for change in worse)]


def last_record_file() -> Path:
    """Return the file of the last run: `benchmarks.json` in the cache folder of uav-twin."""
    return cache_folder() / "benchmarks.json"


def _last_record() -> BenchmarkRecord | None:
    """Return the record of the last run; None if there is none, or it is not usable."""
    if not last_record_file().exists():
        return None
    try:
        return read_record(last_record_file())
    except BenchmarkRecordError as error:
        print(
            f"This run is not compared with the last one, and replaces it: {error}", file=sys.stderr
        )
        return None


def _keep(record: BenchmarkRecord, file: Path | None, last: BenchmarkRecord | None) -> None:
    """Write the record of this run to its file, if it has one, and into that of the last run."""
    if file is not None:
        write_record(file, record)
    last_record_file().parent.mkdir(parents=True, exist_ok=True)
    write_record(last_record_file(), record if last is None else last.updated_by(record))


def benchmark_names() -> list[str]:
    """Return the names of all benchmarks."""
    modules = (module.name for module in pkgutil.iter_modules(benchmarks.__path__))
    return sorted(name.removeprefix(_PREFIX) for name in modules if name.startswith(_PREFIX))


def chosen_benchmarks(words: Sequence[str]) -> list[str]:
    """Return the names of the benchmarks that words choose; all of them without a word.

    A word that is the name of a benchmark chooses this one; another word chooses all whose name
    contains it.
    """
    names = benchmark_names()
    chosen = set() if words else set(names)
    for word in words:
        chosen.update([word] if word in names else [name for name in names if word in name])
    return sorted(chosen)


def load_benchmark(name: str) -> Benchmark:
    """Return the function that measures a benchmark in a process of its own."""
    load = partial(imported_benchmark, f"benchmarks.{_PREFIX}{name}")
    return partial(figures_of_own_process, load)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks",
        description="Measure speed, memory and errors of uav-twin, where possible beside other "
        "programs on the same problem. Each figure is printed when it is measured.",
        epilog=f"The benchmarks are: {', '.join(benchmark_names())}. All of them take about "
        "25 minutes of processor time. Exit code: 0 if every benchmark ran, 1 if one failed (with "
        "--strict also if a target is missed), 2 if the command line or a file is wrong.",
    )
    parser.add_argument(
        "names",
        nargs="*",
        metavar="NAME",
        help="run the benchmark NAME, or those whose name contains it; without a name all of them",
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the record of the run")
    parser.add_argument(
        "--compare",
        type=Path,
        metavar="FILE",
        help="compare with the record of FILE in place of the last run, whose record is "
        "uav-twin/benchmarks.json in the cache folder ($XDG_CACHE_HOME or ~/.cache)",
    )
    parser.add_argument(
        "--remark",
        default="",
        metavar="TEXT",
        help="what a reader of the record must know, such as other work on the machine",
    )
    parser.add_argument(
        "--peer-python",
        metavar="PYTHON",
        help="a Python interpreter in whose environment dynamax is, if this one has none",
    )
    parser.add_argument(
        "--strict", action="store_true", help="exit with code 1 also if a target is missed"
    )
    parser.add_argument(
        "--traceback", action="store_true", help="print where in the code a benchmark failed"
    )
    parser.add_argument("--list", action="store_true", help="print the names of the benchmarks")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmarks of a command line, and return the exit code.

    Parameters
    ----------
    arguments : sequence of str, optional
        The words of the command line; those of the process by default.
    """
    options = _parser().parse_args(arguments)
    names = benchmark_names()
    if options.list:
        print("\n".join(names))
        return 0
    unknown = [word for word in options.names if not any(word in name for name in names)]
    if unknown:
        print(
            f"No benchmark has {unknown[0]!r} in its name; there are: {', '.join(names)}.",
            file=sys.stderr,
        )
        return 2
    if options.peer_python is not None and shutil.which(options.peer_python) is None:
        print(
            f"--peer-python {options.peer_python} is not a program; give the Python interpreter of "
            "an environment that has dynamax, such as peers/bin/python.",
            file=sys.stderr,
        )
        return 2
    try:
        last = _last_record()
        earlier = last if options.compare is None else read_record(options.compare)
    except BenchmarkRecordError as error:
        print(error, file=sys.stderr)
        return 2

    if options.peer_python is not None:
        os.environ[PEER_PYTHON] = options.peer_python
    if earlier is not None:
        print(f"Compared with version {earlier.version} of {earlier.date}.")
    print(lines.HEADING)
    run = BenchmarkRun(earlier, show_traceback=options.traceback)
    try:
        for name in chosen_benchmarks(options.names):
            run.measure(name, partial(load_benchmark, name))
            # After each benchmark, so that an interrupted run keeps what it has measured.
            _keep(run.record(options.remark), options.json, last)
    except (FileNotWrittenError, OSError) as error:
        print(error, file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("Interrupted; the figures of the benchmarks before this one are kept.")
        return 130
    print("\n".join(run.summary()))
    return 1 if run.has_failed or (options.strict and run.missed) else 0


if __name__ == "__main__":
    sys.exit(main())
