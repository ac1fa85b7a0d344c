"""Structures and the wing against CalculiX on the identical mesh: statics, modes and a ring-down.

First how CalculiX runs on an input, and the tables that it prints (`.dat`).
"""

import os
import re
import shutil
import subprocess
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fe.elements.kinds import HEXAHEDRA_20, gauss_points
from fe.full.factorisation import Factorisation
from fe.runtime.arrays import FloatArray
from fe.runtime.errors import CalculixError
from fe.sentences import said
from fe.structure.affine import natural_frequencies

from .calculix_deck import PRINTED, CalculixDeck, Step

PROGRAM = "ccx"
_TIME_LIMIT = 3600.0


def calculix_program() -> str | None:
    """Return the path of CalculiX, or nothing where it is not installed."""
    return shutil.which(PROGRAM)


def required_calculix() -> str:
    """Return the path of CalculiX; raises `CalculixError` where it is not installed."""
    if program := calculix_program():
        return program
    raise CalculixError(said("calculix.missing", program=PROGRAM))


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
            raise CalculixError(said("calculix.table", what=what, error=error)) from None
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


INTEGRATION_POINTS = gauss_points(3)[0][:, ::-1]
"""Local places (27, 3) in 0..1 of the integration points of a C3D20 element, in the order of its output."""


def _relative(theirs: FloatArray, ours: FloatArray) -> float:
    return float(np.abs(theirs - ours).max() / np.abs(ours).max())


class Agreement(NamedTuple):
    """A model and CalculiX.

    Attributes
    ----------
    loads : dict of str to dict of str to float
        Of each load the relative differences, over the largest of their kind: of `nodal displacements`; of
        `gauge strains` and `displacement outputs`, where there are some; of 20-node hexahedra also of
        `strains at integration points`, which CalculiX evaluates itself.
    ours, calculix : (m,) Hz
        Lowest frequencies of both codes.
    """

    loads: dict[str, dict[str, float]]
    ours: FloatArray
    calculix: FloatArray

    @property
    def modal(self) -> float:
        """Largest relative difference of the frequencies."""
        return float(np.abs(self.calculix / self.ours - 1.0).max())


def agreement(deck: CalculixDeck, folder: Path, modes: int = 6) -> Agreement:
    """Solve each load of a model alone, and its lowest modes, by both codes.

    Parameters
    ----------
    deck : CalculixDeck
        The model in one state; a structure is to be assembled with `mass_as_stiffness`, for frequencies that
        can be compared.
    folder : Path
        Where CalculiX works.
    modes : int
        Number of modes.

    Raises
    ------
    CalculixError
        If CalculiX is not there or fails.
    """
    structure, strained = deck.structure, deck.body.mesh.kind is HEXAHEDRA_20
    prints = ["*NODE PRINT, NSET=NALL", "U"]
    prints += ["*NODE PRINT, NSET=NPROBES", "U"] if len(deck.probes) else []
    prints += ["*EL PRINT, ELSET=EALL, GLOBAL=YES", "E"] if strained else []
    text = deck.text(*(step._replace(lines=[*step.lines, *prints]) for step in deck.loads.values()))
    printed = read_tables(run_calculix(text, folder, "static")) if deck.loads else {}
    if (count := len(printed.get("NALL", ()))) != len(deck.loads):
        raise CalculixError(f"CalculiX printed {count} static solutions instead of {len(deck.loads)}.")
    frequencies = natural_frequencies(structure, modes, deck.values)[0]
    text = deck.text(Step(procedure=("*FREQUENCY", f"{modes}")))
    theirs = read_frequencies(run_calculix(text, folder, "modes"))
    if len(theirs) < modes:
        raise CalculixError(f"CalculiX printed {len(theirs)} frequencies instead of {modes}.")
    solve = Factorisation(structure.at(deck.values)[0]).solve
    gauges, end = len(structure.gauges), len(deck.probes)
    parts = {"gauge strains": slice(0, gauges), "displacement outputs": slice(gauges, end)}
    differences = {}
    for number, (name, step) in enumerate(deck.loads.items()):
        displacement, tables = solve(step.load), {key: rows[number] for key, rows in printed.items()}
        ours, nodes = deck.probes @ displacement, structure.full_displacement(displacement)
        found = differences[name] = {"nodal displacements": _relative(tables["NALL"][:, 1:], nodes)}
        for what, own in parts.items():
            if len(ours[own]):
                found[what] = _relative(tables["NPROBES"][:, 1:].ravel()[own], ours[own])
        if strained:
            strains = deck.body.mesh.strains(nodes, local=INTEGRATION_POINTS).reshape(-1, 6)
            strains[:, 3:] *= 0.5  # engineering to tensor shear
            found["strains at integration points"] = _relative(tables["EALL"][:, 2:], strains[:, PRINTED])
    return Agreement(differences, frequencies, theirs[:modes])
