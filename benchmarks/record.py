"""The record of a run of the benchmarks, as JSON: version, date, machine, and all figures."""

import json
import os
import platform
from importlib import metadata
from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError

from benchmarks.measurement import Measurement
from reporting.files import atomic_write_text
from reporting.json_file import read_json

PACKAGES = ("numpy", "scipy", "numba")
"""The packages whose versions are recorded, since most of the computing time is spent in them."""


class BenchmarkRecordError(ValueError):
    """A file is not a record of benchmarks; the message says why."""


class Machine(BaseModel):
    """The computer that the figures were measured on; it names neither the host nor a folder.

    Attributes
    ----------
    processor : str
        The name of the processor, as the processor states it.
    cores : int
        The number of cores that the benchmarks may use.
    system : str
        Operating system and architecture: "Linux x86_64".
    python : str
        The version of Python.
    packages : dict of str to str
        The versions of the packages that compute, by name.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    processor: str
    cores: int
    system: str
    python: str
    packages: dict[str, str]


class Row(BaseModel):
    """A measured figure and the benchmark that measured it.

    Attributes
    ----------
    benchmark : str
        The name of the benchmark: "twin".
    measurement : Measurement
        The figure.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    benchmark: str
    measurement: Measurement

    @property
    def key(self) -> tuple[str, str]:
        """What tells a row from all others: its benchmark, and the name of the figure."""
        return self.benchmark, self.measurement.name


class Unmeasured(BaseModel):
    """A benchmark that did not run to its end.

    Attributes
    ----------
    benchmark : str
        The name of the benchmark.
    sentence : str
        Why it did not run, and what to do.
    failed : bool
        True for a failure, False if something optional is not installed.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    benchmark: str
    sentence: str
    failed: bool


class BenchmarkRecord(BaseModel):
    """A run of the benchmarks.

    Attributes
    ----------
    version : str
        The version of uav-twin.
    date : str
        The day of the run: "2026-11-28".
    machine : Machine
        The computer.
    remark : str
        What a reader must know of the circumstances, such as other work on the machine.
    rows : tuple of Row
        The figures in the order in which they were measured.
    unmeasured : tuple of Unmeasured
        The benchmarks that did not run to their end.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    version: str
    date: str
    machine: Machine
    remark: str = ""
    rows: tuple[Row, ...]
    unmeasured: tuple[Unmeasured, ...] = ()

    def by_key(self) -> dict[tuple[str, str], Measurement]:
        """Return the figures by benchmark and name."""
        return {row.key: row.measurement for row in self.rows}

    def updated_by(self, later: "BenchmarkRecord") -> "BenchmarkRecord":
        """Return a later record with the rows of this one that the later run did not measure."""
        measured = {row.benchmark for row in later.rows}
        remaining = tuple(row for row in self.rows if row.benchmark not in measured)
        return later.model_copy(update={"rows": remaining + later.rows})


def this_machine() -> Machine:
    """Return the computer that this process runs on."""
    return Machine(
        processor=_processor_name(),
        cores=len(os.sched_getaffinity(0)),
        system=f"{platform.system()} {platform.machine()}",
        python=platform.python_version(),
        packages={name: metadata.version(name) for name in PACKAGES},
    )


def _processor_name() -> str:
    """Return the name that the processor states of itself, or the architecture without one."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    for line in lines:
        name, _, value = line.partition(":")
        if name.strip() == "model name":
            return value.strip()
    return platform.machine()


def write_record(path: Path, record: BenchmarkRecord) -> None:
    """Write a record to a file as JSON; raises as `reporting.files.atomic_write_text`."""
    text = json.dumps(record.model_dump(mode="json"), indent=1, ensure_ascii=False, allow_nan=False)
    atomic_write_text(path, text + "\n")


def read_record(path: Path) -> BenchmarkRecord:
    """Return the record of a file.

    Raises
    ------
    BenchmarkRecordError
        If the file cannot be read, is not JSON, or is not a record of benchmarks.
    """
    content = read_json(path, BenchmarkRecordError, what="record of benchmarks")
    try:
        return BenchmarkRecord.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"])) or "the whole file"
        raise BenchmarkRecordError(
            f"The file {path} is not a record of benchmarks: {key}: {first['msg']}. Write one by "
            "`python -m benchmarks --json FILE`."
        ) from None
