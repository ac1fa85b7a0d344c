"""Run CalculiX on an input, and read the tables that it prints (`.dat`)."""

import os
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np

from fe.runtime.arrays import FloatArray
from fe.runtime.errors import CalculixError

PROGRAM = "ccx"
_TIME_LIMIT = 3600.0
_TABLE_HEADER = re.compile(r"^ *(\w[\w ]*?) \(.*\) for set (\w+) and time +\S+$", re.MULTILINE)
_EIGENVALUE_TITLE = "E I G E N V A L U E   O U T P U T"
_NEXT_TITLE = "P A R T I C I P A T I O N"


def calculix_program() -> str | None:
    """Return the path of CalculiX, or None if it is not installed."""
    return shutil.which(PROGRAM)


def required_calculix() -> str:
    """Return the path of CalculiX.

    Raises
    ------
    CalculixError
        If CalculiX is not installed.
    """
    program = calculix_program()
    if program is None:
        raise CalculixError(
            f"CalculiX ('{PROGRAM}') is not installed; on Debian and Ubuntu: apt-get install "
            "calculix-ccx."
        )
    return program


def read_tables(text: str) -> dict[str, list[FloatArray]]:
    """Read the tables of nodes and integration points in a `.dat` file of CalculiX.

    Returns
    -------
    dict of str to list of (n, ...) array
        The tables of each set of nodes or elements, in the order of the file.

    Raises
    ------
    CalculixError
        If a table holds something other than numbers.
    """
    tables: dict[str, list[FloatArray]] = {}
    _, *pieces = _TABLE_HEADER.split(text)
    for quantity, set_name, body in zip(pieces[::3], pieces[1::3], pieces[2::3], strict=True):
        try:
            rows = np.loadtxt(body.splitlines(), ndmin=2)
        except ValueError as error:
            raise CalculixError(
                f"The table of {quantity} that CalculiX printed has a line that is not a row of "
                f"numbers ({error}); another version than 2.20 may print another format."
            ) from None
        tables.setdefault(set_name, []).append(rows)
    return tables


def read_frequencies(text: str) -> FloatArray:
    """Read the frequencies (m,) [Hz] of the table of eigenvalues in a `.dat` file.

    Raises
    ------
    CalculixError
        If there is no such table.
    """
    _, _, from_table = text.partition(_EIGENVALUE_TITLE)
    table, _, _ = from_table.partition(_NEXT_TITLE)
    frequencies = re.findall(r"^ *\d+ +\S+ +\S+ +(\S+) +\S+ *$", table, re.MULTILINE)
    if not frequencies:
        raise CalculixError(
            "CalculiX printed no eigenvalues; see its messages in the folder of the job."
        )
    return np.array(frequencies, dtype=np.float64)


def first_error(log: str) -> str:
    """Return the first error in CalculiX's messages as one line."""
    lines = log.splitlines()
    for number, line in enumerate(lines):
        if "*ERROR" in line:
            following = [line]
            for next_line in lines[number + 1 : number + 5]:
                if not next_line.strip():
                    break
                following.append(next_line)
            return " ".join(" ".join(following).split())
    last_lines = [line.strip() for line in lines if line.strip()][-1:]
    return last_lines[0] if last_lines else "it printed no message."


def run_calculix(text: str, folder: Path, name: str, time_limit: float = _TIME_LIMIT) -> str:
    """Run CalculiX on an input and return the content of its `.dat` file.

    Parameters
    ----------
    folder : Path
        Input, results and messages (`NAME.log`) are written there; it is made if it is missing.
    time_limit : float
        Longest time of the run [s]; an hour by default.

    Raises
    ------
    CalculixError
        If CalculiX is not installed, ends with an error or takes longer than the time limit.
    """
    program = required_calculix()
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.inp").write_text(text, encoding="latin-1")
    try:
        process = subprocess.run(
            [program, "-i", name],
            cwd=folder,
            env={"OMP_NUM_THREADS": "1", **os.environ},
            capture_output=True,
            text=True,
            errors="replace",
            timeout=time_limit,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise CalculixError(
            f"CalculiX took more than {time_limit:g} s for {folder / name}.inp."
        ) from None
    log = folder / f"{name}.log"
    log.write_text(process.stdout + process.stderr, encoding="utf-8")
    result = folder / f"{name}.dat"
    has_finished = process.returncode == 0 and "Job finished" in process.stdout
    if not has_finished or not result.is_file():
        raise CalculixError(
            f"CalculiX did not finish {folder / name}.inp ({first_error(process.stdout)}); its "
            f"messages are in {log}."
        )
    return result.read_text(encoding="ascii", errors="replace")
