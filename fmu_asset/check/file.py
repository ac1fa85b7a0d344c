"""What the file itself tells: the standard's rules, its content, its units and ranges."""

import zipfile
from collections.abc import Iterator

from fmu_asset.archive.declared import FLOAT_KINDS, FmuDescription
from fmu_asset.door.units import contradictions, meaning_of
from fmu_asset.packing.structure_fmu import recorded_content_hash

from .flight import Told


def check_file(description: FmuDescription) -> Iterator[tuple[str, *Told]]:
    """Yield what the file of an FMU tells without running it: name of the check, verdict, sentence."""
    kinds = " and ".join(description.interfaces)
    yield (
        "archive",
        "ok",
        (
            f"FMI {description.fmi_version}, {kinds}, {len(description.variables)} variables, binaries for "
            f"{', '.join(description.platforms)}."
        ),
    )
    yield from _schema(description)
    yield from _content(description)
    yield from _units(description)
    yield from _ranges(description)


def _schema(description: FmuDescription) -> Iterator[tuple[str, *Told]]:
    # It needs a grammar parser and an XML schema; those who only fly an FMU shall not pay for it.
    from fmpy.validation import validate_fmu

    problems = [" ".join(str(problem).split()) for problem in validate_fmu(str(description.path))]
    for problem in problems:
        yield "fmpy validate", "problem", problem
    if not problems:
        yield "fmpy validate", "ok", "The model description keeps the schema and the standard's rules."


def _content(description: FmuDescription) -> Iterator[tuple[str, *Told]]:
    """Compare the GUID of a wing or structure FMU of ours with its content."""
    with zipfile.ZipFile(description.path) as archive:
        names = set(archive.namelist())
    python = {"resources/start.json", "resources/reduced_model.npz"}
    compiled = {"resources/reduced_model.bin", "sources/structure_variables.h"}
    if not (python <= names or compiled <= names):
        return
    changed = "the file was changed after its build."
    try:
        declared, actual = recorded_content_hash(description.path)
    except (KeyError, IndexError, UnicodeDecodeError):
        yield "content", "problem", f"Its parts are not those of an FMU as we build it: {changed}"
        return
    if declared == actual:
        yield "content", "ok", "The GUID is the hash of the content."
    else:
        yield "content", "problem", f"The GUID {declared} does not fit the content ({actual}): {changed}"


def _units(description: FmuDescription) -> Iterator[tuple[str, *Told]]:
    reals = [v for v in description.variables if v.kind in FLOAT_KINDS and v.causality != "independent"]
    bare = [v.name for v in reals if v.unit is None]
    found = contradictions(description.units)
    if bare:
        found.append(f"{len(bare)} real variables have no unit: {', '.join(bare[:5])}.")
    defined = {unit.name for unit in description.units if unit.exponents is not None}
    unknown = {v.unit for v in reals if v.unit and v.unit not in defined and meaning_of(v.unit) is None}
    if unknown:
        listed = ", ".join(sorted(unknown)[:5])
        found.append(f"Nothing can be converted to {listed}: the FMU does not define it in SI.")
    for sentence in found:
        yield "units", "warning", sentence
    if not found:
        yield "units", "ok", "All real variables have units, and these mean what is usual."


def _ranges(description: FmuDescription) -> Iterator[tuple[str, *Told]]:
    inputs = [v for v in description.variables if v.kind in FLOAT_KINDS and v.causality == "input"]
    unlimited = [v.name for v in inputs if v.minimum is None or v.maximum is None]
    empty = [
        v.name
        for v in description.variables
        if v.minimum is not None and v.maximum is not None and v.minimum > v.maximum
    ]
    if empty:
        yield "ranges", "problem", f"The range of {', '.join(empty[:5])} is empty."
    if unlimited:
        yield "ranges", "warning", f"{len(unlimited)} inputs have no range: {', '.join(unlimited[:5])}."
    if inputs and not (unlimited or empty):
        yield "ranges", "ok", "All real inputs have ranges."
