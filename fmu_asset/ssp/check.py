"""Checks an SSP file: its connections are compared with its FMUs, and one step is made."""

import difflib
import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from fmu_asset.client.experiment import default_experiment
from fmu_asset.client.units import IDENTITY, between
from fmu_asset.coupling.asset import Algorithm, CoupledAsset
from fmu_asset.coupling.schedule import loop_sentence
from fmu_asset.coupling.structure import Connector, Endpoint, SystemStructure
from fmu_asset.coupling.system import system_description
from fmu_asset.coupling.wiring import Wiring
from fmu_asset.errors import FmuError, SspError
from fmu_asset.folders import scratch_folder
from reporting.words import comma_list

from .reader import read_ssp

_MOST_HINTS = 12
"""Unused parameters for which a similar name is looked for; messages do not list more."""

_LEAST_SIMILARITY = 0.6


@dataclass(frozen=True)
class SspCheck:
    """The result of checking an SSP file.

    Attributes
    ----------
    problems : tuple of str
        One sentence for each problem; empty if none was found.
    components : tuple of (str, str)
        Name and model name of each component, in the order of their evaluation.
    connections, parameters : int
        The number of connections and of parameters.
    step : float or None
        The size of the step that was made [s]; None if the step failed.
    loops : tuple of str
        Algebraic loops. They are allowed, but `ssp simulate` needs a way to break them.
    unused : tuple of str
        Parameters of the file that no element has, which SSP allows.
    left_out : str
        A sentence about these, with the most similar names of the system; empty if there are none.
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
    """Check that a system fits its FMUs, as the connectors of the SSP file declare them.

    Parameters
    ----------
    delayed : iterable of str
        Ends whose connections are delayed by a step, whatever the file says.

    Raises
    ------
    SspError
        If the file declares a connector of a component otherwise than its FMU.
    CouplingError, FmuFileError, FmuUnsupportedError
        If the system does not fit its FMUs.
    """
    wiring = Wiring(structure.delayed(delayed), leave_out_unknown=True)
    wiring.left_out += structure.unused
    for end, connector in structure.declared.items():
        difference = _difference_from_fmu(wiring, end, connector)
        if difference:
            raise SspError(f"The connector {end} is declared {difference}; correct the file.")
    return wiring


def _difference_from_fmu(wiring: Wiring, end: Endpoint, connector: Connector) -> str:
    """Return how a declared connector differs from the FMU's variable; empty if they agree."""
    variable = wiring.variable(end)
    # SSP 1.0 has no local variables.
    kind_of_fmu = "output" if variable.causality == "local" else variable.causality
    if connector.kind != kind_of_fmu:
        return f"as {connector.kind}, but its FMU has it as {variable.causality}"
    if connector.type is not None and connector.type != variable.base_type:
        return f"of the type {connector.type}, but its FMU has it as {variable.kind}"
    fmu_units = wiring.declared[end.component].units
    known_units = (*wiring.structure.units, *fmu_units)
    if between(connector.unit, known_units, variable.unit, fmu_units) != IDENTITY:
        return f"in {connector.unit!r}, but its FMU has it in {variable.unit!r}"
    return ""


def left_out_sentence(wiring: Wiring, file: Path) -> str:
    """Return the warning about parameters that no element has; empty if all are used.

    Parameters
    ----------
    file : Path
        The SSP file, for the message.
    """
    if not wiring.left_out:
        return ""
    settable_names = _settable_names(wiring)
    names = []
    for index, name in enumerate(wiring.left_out):
        if index < _MOST_HINTS:
            names.append(_name_with_hint(name, settable_names, list(wiring.declared)))
        else:
            names.append(name)
    return (
        f"{file} sets parameters that nothing takes: {comma_list(names)}; correct or remove them."
    )


def _settable_names(wiring: Wiring) -> list[str]:
    """Return the names of all parameters and inputs of the system and its components."""
    names = [
        connector.name for connector in wiring.structure.connectors if connector.kind != "output"
    ]
    for component, description in wiring.declared.items():
        for variable in description.variables:
            if variable.causality in ("parameter", "input"):
                names.append(f"{component}.{variable.name}")
    return names


def _name_with_hint(name: str, settable_names: list[str], components: list[str]) -> str:
    """Add to the name of an unused parameter, such as "wing.mass", what may be wrong with it."""
    # names are compared with those of the same component, without its prefix
    prefixes = [f"{component}." for component in components if name.startswith(f"{component}.")]
    prefix = max(prefixes, key=len, default="")
    candidates = [
        candidate.removeprefix(prefix)
        for candidate in settable_names
        if candidate.startswith(prefix)
    ]
    similar = difflib.get_close_matches(
        name.removeprefix(prefix), candidates, n=1, cutoff=_LEAST_SIMILARITY
    )
    if not similar:
        return name
    correct_name = prefix + similar[0]
    # A mapping of names may ask for the value of a parameter that the set of values does not have.
    if correct_name == name:
        return f"{name} (its parameter set has no such value)"
    return f"{name} (did you mean {correct_name!r}?)"


def check_ssp(path: str | os.PathLike[str]) -> SspCheck:
    """Check an SSP file: archive, schemas, connections, and one step of its FMUs.

    The step is the first one of `ssp simulate`, with the default experiment, in worker processes.

    Raises
    ------
    SspError
        If there is no SSP file to check.
    """
    file = Path(path)
    if not file.is_file():
        raise SspError(f"There is no SSP file {file}.")
    problems: tuple[str, ...] = ()
    step_size: float | None = None
    with scratch_folder() as folder:
        try:
            wiring = join_ssp(read_ssp(file, folder))
        except FmuError as error:
            return SspCheck(file, (str(error),))
        # A system with an algebraic loop is tried too: whether to simulate it is the user's choice.
        try:
            step_size = _make_one_step(wiring)
        except FmuError as error:
            problems = (str(error),)
    order = wiring.schedule
    return SspCheck(
        path=file,
        problems=problems,
        components=tuple((name, wiring.declared[name].model_name) for name in order.order),
        connections=len(wiring.structure.connections),
        parameters=sum(len(settings) for settings in wiring.settings.values()),
        step=step_size,
        loops=(loop_sentence(order.loops),) if order.loops else (),
        unused=tuple(wiring.left_out),
        left_out=left_out_sentence(wiring, file),
    )


def _make_one_step(wiring: Wiring) -> float | None:
    """Make one step of the default experiment, and return its size [s]."""
    experiment = default_experiment(system_description(wiring))
    algorithm: Algorithm = "jacobi" if wiring.schedule.loops else "gauss_seidel"
    with CoupledAsset(wiring, experiment.binding, algorithm=algorithm) as asset:
        asset.step()
    return experiment.binding.step_size
