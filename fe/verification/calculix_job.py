"""Run CalculiX on an input and read the tables that it prints (`.dat`)."""

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


def calculix_program() -> str | None:
    """Return the path of CalculiX, or nothing where it is not installed."""
    return shutil.which(PROGRAM)


def required_calculix() -> str:
    """Return the path of CalculiX; raises `CalculixError` where it is not installed."""
    if program := calculix_program():
        return program
    raise CalculixError(
        f"CalculiX ('{PROGRAM}') is not installed; on Debian and Ubuntu: apt-get install calculix-ccx."
    )


_HEADER = re.compile(r"^ *(\w[\w ]*?) \(.*\) for set (\w+) and time +\S+$", re.MULTILINE)


def read_tables(text: str) -> dict[str, list[FloatArray]]:
    """Read the tables of nodes and integration points of a `.dat` file: rows (n, ...), by the names of sets.

    Raises
    ------
    CalculixError
        If a table holds something other than numbers.
    """
    tables: dict[str, list[FloatArray]] = {}
    _, *found = _HEADER.split(text)
    for what, name, body in zip(found[::3], found[1::3], found[2::3], strict=True):
        try:
            rows = np.loadtxt(body.splitlines(), ndmin=2)
        except ValueError as error:
            raise CalculixError(
                f"The table of {what} that CalculiX printed holds what is not a row of numbers ({error}); "
                "its version may print another format (2.20 is known)."
            ) from None
        tables.setdefault(name, []).append(rows)
    return tables


def read_frequencies(text: str) -> FloatArray:
    """Read the frequencies [Hz] of the table of eigenvalues in a `.dat` file.

    Raises
    ------
    CalculixError
        If there is no such table.
    """
    table = text.partition("E I G E N V A L U E   O U T P U T")[2].partition("P A R T I C I P A T I O N")[0]
    found = re.findall(r"^ *\d+ +\S+ +\S+ +(\S+) +\S+ *$", table, re.MULTILINE)
    if not found:
        raise CalculixError("CalculiX printed no eigenvalues; see its messages in the folder of the job.")
    return np.array(found, dtype=np.float64)


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
    program = required_calculix()
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
    log = folder / f"{name}.log"
    log.write_text(done.stdout + done.stderr, encoding="utf-8")
    result = folder / f"{name}.dat"
    if done.returncode != 0 or "Job finished" not in done.stdout or not result.is_file():
        complaints = [line.strip() for line in done.stdout.splitlines() if "*ERROR" in line]
        said = f" ({complaints[0]})" if complaints else ""
        raise CalculixError(f"CalculiX did not finish {folder / name}.inp{said}; its messages are in {log}.")
    return result.read_text(encoding="ascii", errors="replace")
