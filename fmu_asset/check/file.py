"""Checks of an FMU beyond what flying it shows: the standard's rules, the house's rules, one trial step."""

from __future__ import annotations

import math
import os
import zipfile
from dataclasses import dataclass
from pathlib import Path

from ..archive import FmuDescription, read_fmu
from ..binding import parse_binding
from ..build import recorded_content_hash
from ..errors import FmuError
from ..session import FmiAsset


@dataclass(frozen=True)
class FmuCheck:
    """What the checks found.

    Attributes
    ----------
    path : Path
        The FMU.
    problems : tuple of str
        One sentence each; empty if nothing was found.
    warnings : tuple of str
        What is allowed but makes an FMU harder to use.
    """

    path: Path
    problems: tuple[str, ...]
    warnings: tuple[str, ...]

    @property
    def passed(self) -> bool:
        """Whether nothing was found."""
        return not self.problems


def check_fmu(path: str | os.PathLike[str]) -> FmuCheck:
    """Check an FMU: archive, `fmpy validate`, GUID against content (ours only), and one step in a worker.

    Parameters
    ----------
    path : path-like
        Any FMI 2.0 co-simulation FMU.

    Returns
    -------
    FmuCheck
        Problems and warnings.

    Raises
    ------
    FmuFileError, FmuUnsupportedError
        If there is no FMU to check.
    """
    # It needs a grammar parser and an XML schema; those who only fly an FMU shall not pay for it.
    from fmpy.validation import validate_fmu

    description = read_fmu(path)
    problems = [" ".join(str(problem).split()) for problem in validate_fmu(str(path))]
    problems += _content_problems(description)
    problems += _trial_problems(description)
    return FmuCheck(description.path, tuple(problems), tuple(_warnings(description)))


def _content_problems(description: FmuDescription) -> list[str]:
    with zipfile.ZipFile(description.path) as archive:
        ours = {"resources/start.json", "resources/reduced_model.npz"} <= set(archive.namelist())
    if not ours:
        return []
    try:
        declared, actual = recorded_content_hash(description.path)
    except (KeyError, IndexError, UnicodeDecodeError):
        return [
            "Its parts are not those of a wing FMU as it was built: the file was changed after its build."
        ]
    if declared == actual:
        return []
    return [f"The GUID {declared} does not fit the content ({actual}): the file was changed after its build."]


def _warnings(description: FmuDescription) -> list[str]:
    found = []
    bare = [v.name for v in description.variables if v.kind == "Real" and v.unit is None]
    if bare:
        found.append(f"{len(bare)} real variables have no unit: {', '.join(bare[:5])}.")
    unlimited = [
        v.name
        for v in description.variables
        if v.kind == "Real" and v.causality == "input" and (v.minimum is None or v.maximum is None)
    ]
    if unlimited:
        found.append(f"{len(unlimited)} inputs have no range: {', '.join(unlimited[:5])}.")
    if not (description.can_get_and_set_state and description.can_serialise_state):
        found.append("Its state cannot be serialised; a mission is resumed by replaying the inputs.")
    return found


def _trial_problems(description: FmuDescription) -> list[str]:
    """Make one step with the start values and read every numeric output."""
    outputs = [v.name for v in description.variables if v.causality == "output" and v.kind != "String"]
    if not outputs:
        return ["It has no numeric output."]
    units = {v.name: v.unit or "1" for v in description.variables}
    binding = parse_binding(
        {
            "binding": {"name": "check", "step_size": 1.0},
            "observation": {
                str(number): {"variables": [name], "unit": units[name]} for number, name in enumerate(outputs)
            },
        }
    )
    try:
        with FmiAsset(description.path, binding) as asset:
            asset.observe()
            observation = asset.step()
            if not math.isclose(observation.time, 1.0):
                return [f"After one step of 1 s the time is {observation.time:g} s."]
    except FmuError as error:
        return [str(error)]
    return []
