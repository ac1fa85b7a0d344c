"""What the file itself tells: the standard's rules, its content, its units and ranges."""

import zipfile
from collections.abc import Iterator

from fmu_asset.archive.declared import FLOAT_KINDS, FmuDescription
from fmu_asset.door.unit_symbols import meaning_of
from fmu_asset.door.units import contradictions
from fmu_asset.packing.structure_fmu import recorded_content_hash

from .result import Finding


def check_file(description: FmuDescription) -> Iterator[Finding]:
    """Yield what the file of an FMU tells without running it."""
    yield _archive(description)
    yield from _schema(description)
    yield from _content(description)
    yield from _units(description)
    yield from _ranges(description)


def _archive(description: FmuDescription) -> Finding:
    kinds = " and ".join(description.interfaces)
    count = len(description.variables)
    return Finding(
        "archive",
        "ok",
        f"FMI {description.fmi_version}, {kinds}, {count} variables, binaries for "
        f"{', '.join(description.platforms)}.",
    )


def _schema(description: FmuDescription) -> Iterator[Finding]:
    # It needs a grammar parser and an XML schema; those who only fly an FMU shall not pay for it.
    from fmpy.validation import validate_fmu

    problems = [" ".join(str(problem).split()) for problem in validate_fmu(str(description.path))]
    for problem in problems:
        yield Finding("fmpy validate", "problem", problem)
    if not problems:
        yield Finding(
            "fmpy validate", "ok", "The model description keeps the schema and the standard's rules."
        )


def _content(description: FmuDescription) -> Iterator[Finding]:
    """Compare the GUID of a wing or structure FMU of ours with its content."""
    with zipfile.ZipFile(description.path) as archive:
        names = set(archive.namelist())
    ours = {"resources/start.json", "resources/reduced_model.npz"}
    ours_compiled = {"resources/reduced_model.bin", "sources/structure_variables.h"}
    ours_structure = {"resources/start.json", "resources/structure.npz"}
    if not any(parts <= names for parts in (ours, ours_compiled, ours_structure)):
        return
    try:
        declared, actual = recorded_content_hash(description.path)
    except (KeyError, IndexError, UnicodeDecodeError):
        yield Finding(
            "content",
            "problem",
            "Its parts are not those of an FMU as we build it: the file was changed after its build.",
        )
        return
    if declared == actual:
        yield Finding("content", "ok", "The GUID is the hash of the content.")
    else:
        yield Finding(
            "content",
            "problem",
            f"The GUID {declared} does not fit the content ({actual}): the file was changed after its build.",
        )


def _units(description: FmuDescription) -> Iterator[Finding]:
    reals = [v for v in description.variables if v.kind in FLOAT_KINDS and v.causality != "independent"]
    bare = [v.name for v in reals if v.unit is None]
    found = [Finding("units", "warning", sentence) for sentence in contradictions(description.units)]
    if bare:
        found.append(
            Finding("units", "warning", f"{len(bare)} real variables have no unit: {', '.join(bare[:5])}.")
        )
    defined = {unit.name for unit in description.units if unit.exponents is not None}
    unknown = sorted(
        {v.unit for v in reals if v.unit and v.unit not in defined and meaning_of(v.unit) is None}
    )
    if unknown:
        found.append(
            Finding(
                "units",
                "warning",
                f"Nothing can be converted to {', '.join(unknown[:5])}: the FMU does not define it in SI.",
            )
        )
    yield from found or [
        Finding("units", "ok", "All real variables have units, and these mean what is usual.")
    ]


def _ranges(description: FmuDescription) -> Iterator[Finding]:
    inputs = [v for v in description.variables if v.kind in FLOAT_KINDS and v.causality == "input"]
    unlimited = [v.name for v in inputs if v.minimum is None or v.maximum is None]
    empty = [
        v.name
        for v in description.variables
        if v.minimum is not None and v.maximum is not None and v.minimum > v.maximum
    ]
    if empty:
        yield Finding("ranges", "problem", f"The range of {', '.join(empty[:5])} is empty.")
    if unlimited:
        yield Finding(
            "ranges", "warning", f"{len(unlimited)} inputs have no range: {', '.join(unlimited[:5])}."
        )
    if inputs and not (unlimited or empty):
        yield Finding("ranges", "ok", "All real inputs have ranges.")
