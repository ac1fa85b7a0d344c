"""Ring-down records: the strain signal after release of the tip, raw or read off plots."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from calibration.errors import ExperimentDataError, ExperimentFileError
from calibration.lab_folder import LAB_ERRORS, possible_locations
from reporting.arrays import Float, nan_where_masked
from reporting.formats.table_file import TextTable, parse_table
from reporting.text_file import read_text
from reporting.words import comma_list, counted

STEP_FOLDER = Path("step3")
"""Folder of step 3 in the authors' calibration folder."""

FILE_PATTERNS = (
    "initialconditiondata_*.DAT",
    "initialconditiondata_*.dat",
    "ringdown_trial*_digitised.csv",
)
"""Names of record files, the best kind first: raw at 100 kHz, or read off the published plots."""

MINIMUM_COUNT = 64
"""Fewest samples of a record."""

_RAW_COLUMNS = ["time", "spanwise", "chordwise"]
_TIME_NAMES = ("time", "t", "t_s")
_SIGNAL_NAMES = ("spanwise", "V_mid", "middle")
_LOWEST_NAMES = ("V_low", "lowest")
_HIGHEST_NAMES = ("V_high", "highest")
"""Possible names of the columns of a record; only records read off a plot have the last two."""
_UNEVEN_FRACTION = 0.05  # of a time step, up to which samples may lie off even steps
_ROUNDING = 1e-4  # s; a time printed to few digits may not change between samples at 100 kHz
_CLIPPED_DURATION = 3e-3  # s at the extreme value; natural peaks of a 30 Hz mode are sharper


@dataclass(frozen=True, eq=False)
class RingDownRecord:
    """One trial of the initial-condition test.

    Attributes
    ----------
    time : (N,) array
        The times [s]. They are evenly spaced, up to 0.1 ms by the rounding of a printed time.
    signal : (N,) array
        The spanwise strain signal [V]; its scale does not matter.
    lowest, highest : (N,) array or None
        The extremes of the signal within each interval, for a record read off a plot [V].
    averaging_width : float
        The interval over which each value is an average [s]: the width of a column of pixels; 0 for
        samples.
    source : str
        The name of the file, or another origin, for messages.

    Raises
    ------
    ExperimentDataError
        If the record is shorter than `MINIMUM_COUNT`, a sample is lost, its time does not increase
        evenly, or its signal stays at an extreme for 3 ms, as a clipped signal does.
    """

    time: Float
    signal: Float
    lowest: Float | None = None
    highest: Float | None = None
    averaging_width: float = 0.0
    source: str = "unnamed record"

    def __post_init__(self) -> None:
        if self.count < MINIMUM_COUNT:
            raise ExperimentDataError(
                f"{self.source}: the record has {self.count} samples; "
                f"at least {MINIMUM_COUNT} are needed."
            )
        is_lost = ~np.isfinite(nan_where_masked(self.signal))
        if np.any(is_lost):
            raise ExperimentDataError(
                f"{self.source}: sample {np.flatnonzero(is_lost)[0] + 1} is lost; cut the record "
                "there, or fill it."
            )
        _refuse_uneven_time(self)
        _refuse_constant_signal(self)
        lowest = self.signal if self.lowest is None else self.lowest
        highest = self.signal if self.highest is None else self.highest
        _refuse_clipping(self, lowest, float(lowest.min()), "smallest")
        _refuse_clipping(self, highest, float(highest.max()), "largest")

    @property
    def count(self) -> int:
        """Number of samples."""
        return int(self.time.size)

    @property
    def sampling_rate(self) -> float:
        """Number of samples per second [Hz]."""
        return float((self.count - 1) / (self.time[-1] - self.time[0]))


def _refuse_uneven_time(record: RingDownRecord) -> None:
    """Raise `ExperimentDataError` if the times do not increase in even steps, up to rounding."""
    time = record.time
    step = np.diff(time)
    mean_step = float(time[-1] - time[0]) / (record.count - 1)
    even_time = np.linspace(time[0], time[-1], record.count)
    largest_deviation = np.abs(time - even_time).max()
    is_increasing = step.min() >= 0.0 and mean_step > 0.0
    if is_increasing and largest_deviation <= max(_UNEVEN_FRACTION * mean_step, _ROUNDING):
        return
    usual_step = np.median(step)
    sample = int(np.argmax(np.abs(step - usual_step)))
    raise ExperimentDataError(
        f"{record.source}: times must increase in equal steps, but after sample {sample + 1} the "
        f"step is {step[sample]:.6g} s instead of the usual {usual_step:.6g} s."
    )


def _refuse_constant_signal(record: RingDownRecord) -> None:
    """Raise `ExperimentDataError` if the signal never changes."""
    if np.ptp(record.signal) == 0.0:
        raise ExperimentDataError(
            f"{record.source}: the signal is constant, so that it is not a ring-down."
        )


def _refuse_clipping(record: RingDownRecord, signal: Float, extreme: float, name: str) -> None:
    """Raise `ExperimentDataError` if the signal (N,) stays at an extreme, as if clipped.

    `name` is the word for this extreme in the message.
    """
    is_extreme = np.abs(signal - extreme) <= 1e-9 * np.ptp(signal)
    # Runs of extreme values begin and end where the padded mask changes, in turn.
    padded = np.concatenate([[False], is_extreme, [False]]).astype(np.int8)
    run_boundaries = np.flatnonzero(np.diff(padded))
    starts = run_boundaries[::2]
    ends = run_boundaries[1::2]
    longest_run = int(np.max(ends - starts))
    if longest_run >= 3 and longest_run / record.sampling_rate >= _CLIPPED_DURATION:
        raise ExperimentDataError(
            f"{record.source}: {longest_run} samples in a row have the {name} value {extreme:g}, "
            "as if the recorder had clipped the signal; repeat the test with a wider range."
        )


def read_records(path: Path) -> tuple[RingDownRecord, ...]:
    """Read the ring-down records in the authors' calibration folder, or in one file.

    Parameters
    ----------
    path : Path
        The folder that holds `step3` (also the folder above it in the authors' repository), a
        folder that holds the records themselves, or one file. A text file without header has the
        columns time [s], spanwise and chordwise signal [V], as published at 100 kHz; a CSV file has
        a header with `time` and `spanwise`; a record read off a plot has `t_s`, `V_low`, `V_mid`,
        `V_high`.

    Raises
    ------
    ExperimentFileError
        If there is no record, or a file is empty or lacks a column.
    ExperimentDataError
        If a record holds impossible values; see `RingDownRecord`.
    """
    files = find_records(path)
    if not files:
        raw_pattern, _, read_off_pattern = FILE_PATTERNS
        raise ExperimentFileError(
            f"{path} holds no ring-down record; {raw_pattern} or {read_off_pattern} is needed, "
            f"there or in its folder {STEP_FOLDER}."
        )
    return tuple(_read_record(file) for file in files)


def find_records(path: Path) -> tuple[Path, ...]:
    """Return the files that `read_records` reads: all files of the best kind present.

    Raises
    ------
    ExperimentFileError
        If the path does not exist.
    """
    path = Path(path)
    if path.is_file():
        return (path,)
    if not path.exists():
        raise ExperimentFileError(
            f"{path} does not exist; give a folder of ring-down records or one file."
        )
    for pattern in FILE_PATTERNS:
        for folder in (*possible_locations(path, STEP_FOLDER), path):
            files = sorted(folder.glob(pattern))
            if files:
                return tuple(files)
    return ()


def _read_record(file: Path) -> RingDownRecord:
    """Read the ring-down record in a file of any known layout."""
    text = read_text(file, ExperimentFileError)
    layout = _layout_of(text, file)
    table = parse_table(
        layout.rows, str(file), LAB_ERRORS, header=layout.header, separator=layout.separator
    )
    time = _column(table, _TIME_NAMES)
    signal = _column(table, _SIGNAL_NAMES)
    if "spanwise" in layout.header:
        return RingDownRecord(time, signal, source=file.name)
    return RingDownRecord(
        time,
        signal,
        lowest=_column(table, _LOWEST_NAMES),
        highest=_column(table, _HIGHEST_NAMES),
        averaging_width=float(np.median(np.diff(time))) if time.size > 1 else 0.0,
        source=file.name,
    )


class _Layout(NamedTuple):
    """The layout of a record file.

    Attributes
    ----------
    separator : str or None
        The character between cells; None for white space.
    rows : str
        The text, with the header line turned into a comment.
    """

    header: Sequence[str]
    separator: str | None
    rows: str


def _layout_of(text: str, file: Path) -> _Layout:
    """Infer the layout of a record file from its first line.

    The line is a header if it contains anything but numbers; a file without header has the columns
    of the published records.
    """
    filled_lines = [line for line in text.splitlines() if line.strip()]
    if not filled_lines:
        raise ExperimentFileError(
            f"{file} is empty; columns of time [s] and spanwise signal [V] are needed."
        )
    first_line = filled_lines[0].strip()
    separator = "," if "," in first_line and "\t" not in first_line else None
    header_match = re.search(r"[^\d\s.,;eE+-]", first_line.lstrip("#"))
    if header_match:
        header = _column_names(first_line, separator, file)
        if not first_line.startswith("#"):
            text = text.replace(first_line, f"#{first_line}", 1)
        return _Layout(header, separator, text)
    count = len(first_line.split(separator))
    if not 2 <= count <= len(_RAW_COLUMNS):
        raise ExperimentFileError(
            f"{file} has {counted(count, 'column')}; time [s], spanwise and, if there is one, "
            "chordwise signal [V] are needed, without header."
        )
    return _Layout(_RAW_COLUMNS[:count], separator, text)


def _column_names(header_line: str, separator: str | None, file: Path) -> list[str]:
    """Return the names of the columns in a header line, without their units."""
    if separator is not None:
        between_cells = separator
    else:
        between_cells = r"\t+" if "\t" in header_line else r"\s+"
    # A remark in brackets may hold separators of its own.
    outside_brackets = r"(?![^(\[]*[)\]])"
    cells = re.split(between_cells + outside_brackets, header_line.lstrip("#").strip())
    return [_column_name(cell.strip().strip('"'), file) for cell in cells]


def _column_name(cell: str, file: Path) -> str:
    """Return the name in a header cell, without unit and remarks in brackets.

    Raises `ExperimentDataError` if the time has another unit than s.
    """
    name = re.split(r"\s*[(\[]", cell, maxsplit=1)[0]
    unit = re.search(r"[(\[]\s*(\w+)\s*[)\]]", cell)
    if name in _TIME_NAMES and unit and unit[1] not in ("s", "sec", "second", "seconds"):
        raise ExperimentDataError(f"{file} gives {name} in {unit[1]}: give it in s.")
    return name


def _column(table: TextTable, names: tuple[str, ...]) -> Float:
    """Return the numbers of the column that has one of several possible names."""
    for name in names:
        if name in table.columns:
            return table.numbers(name, "a ring-down")
    raise ExperimentFileError(
        f"{table.name} lacks the column {' or '.join(names)}; "
        f"its columns are {comma_list(table.columns)}."
    )
