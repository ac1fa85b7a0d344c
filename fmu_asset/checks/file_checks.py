"""Checks of an FMU's file that do not run it."""

import zipfile
from collections.abc import Callable, Iterator

from fmu_asset.archive.declared import FLOAT_KINDS, FmuDescription
from fmu_asset.client.units import contradictions
from fmu_asset.packing.structure_fmu import recorded_content_hash
from reporting.units import conversion_of

from .finding import CheckResult, Finding

_MOST_NAMES = 5
"""The largest number of names that a message lists."""
_PYTHON_MEMBERS = {"resources/start.json", "resources/reduced_model.npz"}
"""Members of a Python FMU of a wing or structure that we have packed."""
_COMPILED_MEMBERS = {"resources/reduced_model.bin", "sources/structure_variables.h"}
"""Members of a compiled FMU of a wing or structure that we have packed."""


def check_file(description: FmuDescription) -> Iterator[Finding]:
    """Yield the findings of all checks that read an FMU's file without running it."""
    checks: dict[str, Callable[[FmuDescription], list[CheckResult]]] = {
        "archive": _check_archive,
        "fmpy validate": _check_schema,
        "content": _check_content,
        "units": _check_units,
        "ranges": _check_ranges,
    }
    for name, check in checks.items():
        for result in check(description):
            yield result.named(name)


def _listed(names: list[str]) -> str:
    """Return the first names of a list, for a message."""
    return ", ".join(names[:_MOST_NAMES])


def _check_archive(description: FmuDescription) -> list[CheckResult]:
    """Report version, interfaces, variables and platforms; `read_fmu` has checked the rest."""
    interfaces = " and ".join(description.interfaces)
    platforms = ", ".join(description.platforms)
    text = (
        f"FMI {description.fmi_version}, {interfaces}, {len(description.variables)} variables, "
        f"binaries for {platforms}."
    )
    return [CheckResult("ok", text)]


def _check_schema(description: FmuDescription) -> list[CheckResult]:
    """Check the model description against the XML schema and the rules of FMI, by fmpy."""
    # Imported here, as it loads a grammar parser and an XML schema that nothing else needs.
    from fmpy.validation import validate_fmu

    problems = validate_fmu(str(description.path))
    if not problems:
        text = "The model description keeps the schema and the standard's rules."
        return [CheckResult("ok", text)]
    return [CheckResult("problem", " ".join(str(problem).split())) for problem in problems]


def _check_content(description: FmuDescription) -> list[CheckResult]:
    """Check that a wing or structure FMU of this package is unchanged since its build.

    Its GUID is the hash of its content. There is no result for other FMUs.
    """
    with zipfile.ZipFile(description.path) as archive:
        members = set(archive.namelist())
    if not (members >= _PYTHON_MEMBERS or members >= _COMPILED_MEMBERS):
        return []
    try:
        declared, actual = recorded_content_hash(description.path)
    except (KeyError, IndexError, UnicodeDecodeError):
        text = (
            "Its parts are not those of an FMU as we build it: the file was changed after its "
            "build."
        )
        return [CheckResult("problem", text)]
    if declared == actual:
        return [CheckResult("ok", "The GUID is the hash of the content.")]
    text = (
        f"The GUID {declared} does not fit the content ({actual}): the file was changed after its "
        "build."
    )
    return [CheckResult("problem", text)]


def _check_units(description: FmuDescription) -> list[CheckResult]:
    """Check that real variables other than time have convertible units with their usual meaning."""
    reals = [
        variable
        for variable in description.variables
        if variable.kind in FLOAT_KINDS and variable.causality != "independent"
    ]
    sentences = contradictions(description.units)
    without_unit = [variable.name for variable in reals if variable.unit is None]
    if without_unit:
        count = len(without_unit)
        sentences.append(f"{count} real variables have no unit: {_listed(without_unit)}.")
    defined = {unit.name for unit in description.units if unit.exponents is not None}
    used_units = {variable.unit for variable in reals if variable.unit}
    unknown_units = [unit for unit in sorted(used_units - defined) if conversion_of(unit) is None]
    if unknown_units:
        sentences.append(
            f"Nothing can be converted to {_listed(unknown_units)}: the FMU does not define it in "
            "SI."
        )
    if not sentences:
        text = "All real variables have units, and these have their usual meaning."
        return [CheckResult("ok", text)]
    return [CheckResult("warning", sentence) for sentence in sentences]


def _check_ranges(description: FmuDescription) -> list[CheckResult]:
    """Check that real inputs have ranges, and that no range is empty."""
    names_of_empty_ranges = []
    for variable in description.variables:
        low = variable.minimum
        high = variable.maximum
        if low is not None and high is not None and low > high:
            names_of_empty_ranges.append(variable.name)
    inputs = [
        variable
        for variable in description.variables
        if variable.kind in FLOAT_KINDS and variable.causality == "input"
    ]
    unlimited = [
        variable.name for variable in inputs if variable.minimum is None or variable.maximum is None
    ]
    results = []
    if names_of_empty_ranges:
        results.append(
            CheckResult("problem", f"The range of {_listed(names_of_empty_ranges)} is empty.")
        )
    if unlimited:
        text = f"{len(unlimited)} inputs have no range: {_listed(unlimited)}."
        results.append(CheckResult("warning", text))
    if inputs and not results:
        results.append(CheckResult("ok", "All real inputs have ranges."))
    return results
