"""Run CalculiX on an input and read the tables that it prints (`.dat`)."""

import os
import re
import shutil
import subprocess
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fe.runtime.errors import CalculixError

FloatArray = NDArray[np.float64]

PROGRAM = "ccx"
_TIME_LIMIT = 3600.0


def calculix_program() -> str | None:
    """Return the path of CalculiX, or nothing where it is not installed."""
    return shutil.which(PROGRAM)


class PrintedBlock(NamedTuple):
    """A table of a `.dat` file: what it is, of which set, at which time [s], and its rows."""

    quantity: str
    set_name: str
    time: float
    rows: FloatArray


_HEADER = re.compile(r"^ *(\w[\w ]*?) \(.*\) for set (\w+) and time +(\S+)$")


def read_tables(text: str) -> list[PrintedBlock]:
    """Read the tables of nodes and integration points of a `.dat` file.

    Raises
    ------
    CalculixError
        If a table holds something other than numbers.
    """
    blocks: list[PrintedBlock] = []
    rows: list[list[float]] = []
    head: tuple[str, str, float] | None = None
    for line in [*text.splitlines(), " end (of file) for set NONE and time 0"]:
        match = _HEADER.match(line)
        if match:
            if head is not None:
                blocks.append(PrintedBlock(*head, np.array(rows)))
            head, rows = (match[1], match[2], float(match[3])), []
        elif head is not None and line.strip():
            try:
                rows.append([float(value) for value in line.split()])
            except ValueError:
                raise CalculixError(
                    f"The table of {head[0]} that CalculiX printed holds the line {line.strip()!r}, which is "
                    "not a row of numbers; its version may print another format (2.20 is known)."
                ) from None
    return blocks


def read_frequencies(text: str) -> FloatArray:
    """Read the frequencies [Hz] of the table of eigenvalues in a `.dat` file.

    Raises
    ------
    CalculixError
        If there is no such table.
    """
    _, found, table = text.partition("E I G E N V A L U E   O U T P U T")
    frequencies = []
    for line in table.splitlines():
        parts = line.split()
        if len(parts) == 5 and parts[0].isdigit():
            frequencies.append(float(parts[3]))
        elif frequencies:
            break
    if not found or not frequencies:
        raise CalculixError("CalculiX printed no eigenvalues; see its messages in the folder of the job.")
    return np.array(frequencies)


def run_calculix(text: str, folder: Path, name: str) -> str:
    """Run CalculiX on an input and return the content of its `.dat` file.

    Parameters
    ----------
    text : str
        The input.
    folder : Path
        Where input, results and messages (`NAME.log`) are written; it is made if it is not there.
    name : str
        Name of the job.

    Raises
    ------
    CalculixError
        If CalculiX is not installed, ends with an error or takes more than an hour.
    """
    program = calculix_program()
    if program is None:
        raise CalculixError(
            f"CalculiX ('{PROGRAM}') is not installed; on Debian and Ubuntu: apt-get install calculix-ccx."
        )
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.inp").write_text(text, encoding="ascii")
    try:
        done = subprocess.run(
            [program, "-i", name],
            cwd=folder,
            env={"OMP_NUM_THREADS": "1", **os.environ},
            capture_output=True,
            text=True,
            errors="replace",
            timeout=_TIME_LIMIT,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise CalculixError(f"CalculiX took more than {_TIME_LIMIT:g} s for {folder / name}.inp.") from None
    except OSError as error:
        raise CalculixError(f"CalculiX ({program}) cannot be run: {error.strerror}.") from None
    log = folder / f"{name}.log"
    log.write_text(done.stdout + done.stderr, encoding="utf-8")
    result = folder / f"{name}.dat"
    if done.returncode != 0 or "Job finished" not in done.stdout or not result.is_file():
        complaints = [line.strip() for line in done.stdout.splitlines() if "*ERROR" in line]
        said = f" ({complaints[0]})" if complaints else ""
        raise CalculixError(f"CalculiX did not finish {folder / name}.inp{said}; its messages are in {log}.")
    return result.read_text(encoding="ascii", errors="replace")
