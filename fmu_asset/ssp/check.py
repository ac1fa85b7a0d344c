"""An SSP file against its own FMUs: joined, and tried for one step."""

import difflib
import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from fmu_asset.client.experiment import default_experiment
from fmu_asset.client.units import IDENTITY, between
from fmu_asset.coupling.asset import Algorithm, CoupledAsset
from fmu_asset.coupling.structure import SystemStructure
from fmu_asset.coupling.system import system_description
from fmu_asset.coupling.wiring import Wiring, loop_sentence
from fmu_asset.errors import FmuError, SspError, said
from fmu_asset.folders import scratch_folder

from .reader import read_ssp


@dataclass(frozen=True)
class SspCheck:
    """What a check of an SSP file found.

    Attributes
    ----------
    path : Path
        The file.
    problems : tuple of str
        One sentence each; empty if nothing was found.
    components : tuple of (str, str)
        Name of each component and of its model, in the order in which they are evaluated.
    connections, parameters : int
        How many there are.
    step : float or None
        The step that was made [s]; None where none could be made.
    loops : tuple of str
        Algebraic loops; a system with one is sound, but `ssp simulate` needs to be told how to break it.
    unused : tuple of str
        Parameters that the file sets and nothing takes, which SSP allows.
    left_out : str
        A sentence on them, with the nearest names of the system; empty if there are none.
    """

    path: Path
    problems: tuple[str, ...]
    components: tuple[tuple[str, str], ...] = ()
    connections: int = 0
    parameters: int = 0
    step: float | None = None
    loops: tuple[str, ...] = ()
    unused: tuple[str, ...] = ()
    left_out: str = ""


def join_ssp(structure: SystemStructure, delayed: Iterable[str] = ()) -> Wiring:
    """Join a system that was read, and check that its connectors are those of its FMUs.

    Parameters
    ----------
    structure : SystemStructure
        As `reader.read_ssp` returns it.
    delayed : iterable of str
        Ends whose connections are delayed by a step, whatever the file says.

    Raises
    ------
    SspError
        If a connector of a component is declared otherwise than its FMU has it.
    CouplingError, FmuFileError, FmuUnsupportedError
        If the system does not fit its FMUs.
    """
    wiring = Wiring(structure.delayed(delayed), leave_out_unknown=True)
    wiring.left_out += structure.unused
    for end, declared in structure.declared.items():
        variable, units = wiring.variable(end), wiring.declared[end.component].units
        same_unit = between(declared.unit, (*structure.units, *units), variable.unit, units) == IDENTITY
        # SSP 1.0 has no local variables.
        own_kind = "output" if variable.causality == "local" else variable.causality
        if declared.kind != own_kind:
            differs = f"as {declared.kind}, but its FMU has it as {variable.causality}"
        elif declared.type not in (None, variable.base_type):
            differs = f"of the type {declared.type}, but its FMU has it as {variable.kind}"
        elif not same_unit:
            differs = f"in {declared.unit!r}, but its FMU has it in {variable.unit!r}"
        else:
            continue
        raise SspError(f"The connector {end} is declared {differs}; correct the file.")
    return wiring


def left_out_sentence(wiring: Wiring, file: Path) -> str:
    """Return what of a file's parameters goes nowhere, with the nearest names; empty if all are used."""
    if not wiring.left_out:
        return ""
    known = [item.name for item in wiring.structure.connectors if item.kind != "output"]
    for component, declared in wiring.declared.items():
        settable = (v for v in declared.variables if v.causality in ("parameter", "input"))
        known += [f"{component}.{variable.name}" for variable in settable]
    names = list(wiring.left_out)
    for index, name in enumerate(names[:12]):  # more are not listed
        owner = max((f"{c}." for c in wiring.declared if name.startswith(f"{c}.")), key=len, default="")
        own = [item.removeprefix(owner) for item in known if item.startswith(owner)]
        for near in difflib.get_close_matches(name.removeprefix(owner), own, 1, 0.6):
            right = owner + near
            hint = "its set lacks the value" if right == name else f"did you mean {right!r}?"
            names[index] = f"{name} ({hint})"
    return said("ssp.untaken", file=file, names=names)


def check_ssp(path: str | os.PathLike[str]) -> SspCheck:
    """Check an SSP file: archive, schemas, connections against the FMUs, and one step in workers.

    The step is the one that `ssp simulate` takes, of the default experiment.

    Raises
    ------
    SspError
        If there is no SSP file to check.
    """
    file = Path(path)
    if not file.is_file():
        raise SspError(f"There is no SSP file {file}.")
    problems: tuple[str, ...] = ()
    step: float | None = None
    with scratch_folder() as folder:
        try:
            wiring = join_ssp(read_ssp(file, folder))
        except FmuError as error:
            return SspCheck(file, (str(error),))
        plan = wiring.schedule
        try:  # with an algebraic loop, too: whether it may be simulated is the user's choice
            experiment = default_experiment(system_description(wiring))
            algorithm: Algorithm = "jacobi" if plan.loops else "gauss_seidel"
            with CoupledAsset(wiring, experiment.binding, algorithm=algorithm) as asset:
                asset.step()
            step = experiment.binding.step_size
        except FmuError as error:
            problems = (str(error),)
    return SspCheck(
        path=file,
        problems=problems,
        components=tuple((name, wiring.declared[name].model_name) for name in plan.order),
        connections=len(wiring.structure.connections),
        parameters=sum(map(len, wiring.settings.values())),
        step=step,
        loops=(loop_sentence(plan.loops),) if plan.loops else (),
        unused=tuple(wiring.left_out),
        left_out=left_out_sentence(wiring, file),
    )
