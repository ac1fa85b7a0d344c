"""Ring-down records: the strain signal after the tip is let go, raw or read off the published plots."""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calibration.errors import ExperimentDataError, ExperimentFileError, said
from calibration.lab_folder import LAB_ERRORS, places_of
from reporting.arrays import Float
from reporting.table_file import TextTable, parse_table
from reporting.text_file import read_text
from reporting.words import counted

STEP_FOLDER = Path("step3")
"""Folder of step 3 in the authors' calibration folder."""

FILE_PATTERNS = ("initialconditiondata_*.DAT", "initialconditiondata_*.dat", "ringdown_trial*_digitised.csv")
"""Names of the records there, best first: raw at 100 kHz, or read off the published plots."""

MINIMUM_COUNT = 64
"""Fewest samples that a record may have."""

_RAW_COLUMNS = ["time", "spanwise", "chordwise"]
_NAMES = (
    ("time", "t", "t_s"), ("spanwise", "V_mid", "middle"), ("V_low", "lowest"), ("V_high", "highest"),
)  # fmt: skip
"""What the columns of a record may be called, those of a record read off a plot last."""
_ROUNDING = 1e-4  # s; a time printed to few digits may stand still at 100 kHz
_CLIPPED_DURATION = 3e-3  # s at the extreme value; natural peaks of a 30 Hz mode are sharper


@dataclass(frozen=True, eq=False)
class RingDownRecord:
    """One trial of the initial-condition test.

    Attributes
    ----------
    time : (N,) array
        Instants, evenly spaced but for the rounding of a printed time, 0.1 ms at most [s].
    signal : (N,) array
        Spanwise strain signal [V]; its scale does not matter.
    lowest, highest : (N,) array or None
        Extremes of the signal within each interval, for a record read off a plot [V].
    averaging_width : float
        Interval over which each value is an average: the width of a column of pixels; 0 for samples [s].
    source : str
        Where the record comes from.

    Raises
    ------
    ExperimentDataError
        If the record is shorter than `MINIMUM_COUNT`, time does not run evenly upwards, or the signal stands
        still at an extreme for 3 ms, as a clipped one does.
    """

    time: Float
    signal: Float
    lowest: Float | None = None
    highest: Float | None = None
    averaging_width: float = 0.0
    source: str = "unnamed record"

    def __post_init__(self) -> None:
        if self.count < MINIMUM_COUNT:
            raise ExperimentDataError(said("record.samples", self=self, least=MINIMUM_COUNT))
        step = np.diff(self.time)
        usual = float(self.time[-1] - self.time[0]) / (self.count - 1)
        astray = np.abs(self.time - np.linspace(self.time[0], self.time[-1], self.count)).max()
        if not (step.min() >= 0.0 and usual > 0.0 and astray <= max(0.05 * usual, _ROUNDING)):
            place = int(np.argmax(np.abs(step - np.median(step))))
            steps = step[place], np.median(step)
            raise ExperimentDataError(said("record.uneven", self=self, number=place + 1, steps=steps))
        _refuse_clipped(self)

    @property
    def count(self) -> int:
        """Number of samples."""
        return int(self.time.size)

    @property
    def sampling_rate(self) -> float:
        """Samples per second [Hz]."""
        return float((self.count - 1) / (self.time[-1] - self.time[0]))


def read_records(path: Path) -> tuple[RingDownRecord, ...]:
    """Read the ring-down trials from the authors' calibration folder, or one record from its file.

    Parameters
    ----------
    path : Path
        The folder that holds `step3` (also the folder above it in the authors' repository), a folder that
        holds the records themselves, or one file. A text file without header has the columns time [s],
        spanwise and chordwise signal [V], as published at 100 kHz; a CSV file has a header with `time` and
        `spanwise`; a record read off a plot has `t_s`, `V_low`, `V_mid`, `V_high`.

    Raises
    ------
    ExperimentFileError
        If there is no record, or a file is empty or lacks a column.
    ExperimentDataError
        If a record holds values that none can have; see `RingDownRecord`.
    """
    files = find_records(path)
    if not files:
        raise ExperimentFileError(said("record.none", path=path, files=FILE_PATTERNS, folder=STEP_FOLDER))
    return tuple(_read_record(file) for file in files)


def find_records(path: Path) -> tuple[Path, ...]:
    """Return the files that `read_records` reads, best kind first; none if there are none.

    Raises
    ------
    ExperimentFileError
        If the path does not exist.
    """
    path = Path(path)
    if path.is_file():
        return (path,)
    if not path.exists():
        raise ExperimentFileError(f"{path} does not exist; give a folder of ring-down records or one file.")
    for pattern in FILE_PATTERNS:
        for folder in (*places_of(path, STEP_FOLDER), path):
            if files := sorted(folder.glob(pattern)):
                return tuple(files)
    return ()


def _read_record(file: Path) -> RingDownRecord:
    text = read_text(file, ExperimentFileError)
    first = next((line for line in text.splitlines() if line.strip()), "").strip()
    if not first:
        raise ExperimentFileError(f"{file} is empty; columns of time [s] and spanwise signal [V] are needed.")
    separator = "," if "," in first and "\t" not in first else None
    header = _RAW_COLUMNS[: len(first.split(separator))]
    if re.search(r"[^\d\s.,;eE+-]", first.lstrip("#")):  # a word
        # A remark in brackets may hold separators of its own.
        between = separator or (r"\t+" if "\t" in first else r"\s+")
        cells = re.split(between + r"(?![^(\[]*[)\]])", first.lstrip("#").strip())
        header = [_named(cell.strip().strip('"'), file) for cell in cells]
        text = text if first.startswith("#") else text.replace(first, f"#{first}", 1)
    elif not 2 <= (count := len(first.split(separator))) <= len(_RAW_COLUMNS):
        came = counted(count, "column")
        raise ExperimentFileError(said("record.columns", file=file, came=came))
    table = parse_table(text, str(file), LAB_ERRORS, header=header, separator=separator)
    time, signal = (_column(table, spellings) for spellings in _NAMES[:2])
    if "spanwise" in header:
        return RingDownRecord(time, signal, source=file.name)
    lowest, highest = (_column(table, spellings) for spellings in _NAMES[2:])
    width = float(np.median(np.diff(time))) if time.size > 1 else 0.0
    return RingDownRecord(time, signal, lowest, highest, width, file.name)


def _named(cell: str, file: Path) -> str:
    """Return the name in a header's cell without unit or remark in brackets."""
    name = re.split(r"\s*[(\[]", cell, maxsplit=1)[0]
    unit = re.search(r"[(\[]\s*(\w+)\s*[)\]]", cell)
    if name in _NAMES[0] and unit and unit[1] not in ("s", "sec", "second", "seconds"):
        raise ExperimentDataError(f"{file} gives {name} in {unit[1]}: give it in s.")
    return name


def _column(table: TextTable, spellings: tuple[str, ...]) -> Float:
    for name in spellings:
        if name in table.columns:
            return table.numbers(name, "a ring-down")
    raise ExperimentFileError(said("record.no_column", table=table, wanted=" or ".join(spellings)))


def _refuse_clipped(record: RingDownRecord) -> None:
    if np.ptp(record.signal) == 0.0:
        raise ExperimentDataError(f"{record.source}: the signal is constant; nothing rings.")
    lowest = record.signal if record.lowest is None else record.lowest
    highest = record.signal if record.highest is None else record.highest
    for column, extreme, name in ((lowest, lowest.min(), "smallest"), (highest, highest.max(), "largest")):
        there = np.abs(column - extreme) <= 1e-9 * np.ptp(column)
        edges = np.flatnonzero(np.diff(np.concatenate([[False], there, [False]]).astype(np.int8)))
        run = int(np.max(edges[1::2] - edges[::2]))
        if run >= 3 and run / record.sampling_rate >= _CLIPPED_DURATION:
            raise ExperimentDataError(said("record.clipped", record=record, run=run, name=name, end=extreme))
