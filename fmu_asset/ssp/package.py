"""The SSP archive in the words of SSP 1.0, its XML valid by the schemas: checked and read, or written.

Equal systems give equal bytes.
"""

import os
import posixpath
import zipfile
import zlib
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from lxml import etree

from fe.runtime.arrays import archive_bytes
from fmu_asset.archive.declared import VariableInfo
from fmu_asset.archive.fmu_file import check_archive
from fmu_asset.coupling.structure import Endpoint
from fmu_asset.coupling.wiring import Wiring
from fmu_asset.description import rendered
from fmu_asset.errors import FmuFileError, SspError, said
from fmu_asset.instances.plan import Interface
from fmu_asset.packing.contents import checked_target
from reporting.files import atomic_write_bytes
from reporting.units import BASE_UNITS

SSD_NAME = "SystemStructure.ssd"
NAMESPACES = {
    "ssc": "http://ssp-standard.org/SSP1/SystemStructureCommon",
    "ssd": "http://ssp-standard.org/SSP1/SystemStructureDescription",
    "ssv": "http://ssp-standard.org/SSP1/SystemStructureParameterValues",
    "ssm": "http://ssp-standard.org/SSP1/SystemStructureParameterMapping",
}
"""By kind of document; the last word is the name of its schema."""
OWN_NAMESPACE = "urn:uav-twin:coupling"
"""Of the annotations that say what SSP 1.0 has no word for: delayed connections, several steps in one."""
INTERFACES: dict[str, Interface | None] = {
    "any": None,
    "CoSimulation": "co-simulation",
    "ModelExchange": "model-exchange",
}

_NUMBERS_OF_2 = {
    "Float32": "Real",
    "Float64": "Real",
    **{f"{sign}Int{bits}": "Integer" for sign in ("", "U") for bits in (8, 16, 32, 64)},
}
_LEFT_OUT_OF_2 = ("MetaData", "Signature")
_UNSUPPORTED = {
    "Binary": "a binary connector",
    "Clock": "a clock",
    "Dimension": "an array",
    "SignalDictionaries": "signal dictionaries",
    "SignalDictionaryReference": "signal dictionaries",
    **{
        f"{kind}MappingTransformation": f"a {kind}MappingTransformation"
        for kind in ("Boolean", "Integer", "Enumeration")
    },
}
_HOLD_COMMON = ("Units", "Enumerations", "Annotations", "MappingEntry")
"""Elements of parameter sets and mappings below which the common namespace begins."""


class SspPackage:
    """An SSP file that was checked: sound, safe, and with a system structure in it.

    Raises
    ------
    SspError
        If the file is missing, damaged or unsafe, or holds no system structure.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        if not self.path.is_file():
            raise SspError(said("ssp.absent", self=self))
        with SspError.instead_of(FmuFileError):
            self.names = check_archive(self.path, self.path.stat().st_size, "SSP", "export")
        if SSD_NAME not in self.names:
            raise SspError(f"{self.path} is an archive without {SSD_NAME}, so it is no SSP file.")

    def read(self, name: str) -> bytes:
        """Return the content of a file in the archive."""
        try:
            with zipfile.ZipFile(self.path) as archive:
                return archive.read(name)
        except (OSError, KeyError, zipfile.BadZipFile, zlib.error) as error:
            raise SspError(f"{name} in {self.path} cannot be read ({error}).") from error

    def resolve(self, source: str, what: str) -> str:
        """Return the name in the archive that a URI of the system structure stands for.

        Raises
        ------
        SspError
            If it leads outside the archive, or there is no such file in it.
        """
        parts = urlsplit(source)
        name = posixpath.normpath(unquote(parts.path))
        outside = parts.scheme or parts.netloc or parts.query or parts.fragment
        if outside or not parts.path or name.startswith(("/", "..")) or "\\" in name:
            raise SspError(said("ssp.outside", what=what, self=self, source=source))
        if name not in self.names:
            raise SspError(f"{what} in {self.path} names the source {source!r}, which is not in the archive.")
        return name

    def parse(self, kind: str, name: str, content: bytes | None = None) -> Any:
        """Return the root element of an XML document, valid by the schema of its kind.

        Parameters
        ----------
        kind : {"ssd", "ssv", "ssm"}
            What it must be.
        name : str
            The file in the archive, or what `content` is.
        content : bytes, optional
            Its text, where it does not stand in a file of its own.
        """
        where = f"{name} in {self.path}"
        root = parse_xml(self.read(name) if content is None else content, where)
        if not root.tag.startswith("{"):
            _put_into_namespace(root, kind)
        _in_words_of_1(root, where)
        validate(root, kind, where)
        return root


def parse_xml(content: bytes, where: str) -> Any:
    """Return the root of an XML text; neither entities nor anything outside is read.

    Raises
    ------
    SspError
        If it is not well-formed, or declares entities.
    """
    parser = etree.XMLParser(resolve_entities=False, no_network=True, load_dtd=False, huge_tree=False)
    try:
        root = etree.fromstring(content, parser)
    except etree.XMLSyntaxError as error:
        raise SspError(f"{where} is not well-formed XML ({error.msg}).") from error
    if root.getroottree().docinfo.doctype:
        raise SspError(said("ssp.document_type", where=where))
    return root


def _in_words_of_1(root: Any, where: str) -> None:
    """Put a document into those words of SSP 1.0 that are read.

    Of SSP 2.0, which has the same namespaces and more words, the numbers of FMI 3 become the two that 1.0
    knows; what FMU they come from decides their size. Metadata and signatures are left out.

    Raises
    ------
    SspError
        If it has what is not read.
    """
    for element in list(root.iter(etree.Element)):
        tag = etree.QName(element)
        if tag.namespace not in NAMESPACES.values():
            continue
        if str(element.get("version", "")).startswith("2."):
            element.set("version", "1.0")
        if tag.localname in _LEFT_OUT_OF_2:
            element.getparent().remove(element)
        elif tag.localname in _NUMBERS_OF_2:
            element.tag = f"{{{tag.namespace}}}{_NUMBERS_OF_2[tag.localname]}"
        # A value that is binary is refused where something takes it.
        missing = _UNSUPPORTED.get("" if tag.namespace == NAMESPACES["ssv"] else tag.localname)
        if element.get("kind") in ("clock", "structuralParameter"):
            missing = f"a connector of the kind {element.get('kind')}"
        if tag.localname == "Component" and element.get("source") is None:
            missing = f"the component {element.get('name')!r} without a source"
        if missing:
            raise SspError(said("ssp.unsupported", where=where, missing=missing, element=element))


def _put_into_namespace(element: Any, kind: str) -> None:
    """Give the namespaces of SSP 1.0 to a document that some tools write without any."""
    inner = "ssc" if element.tag in _HOLD_COMMON else kind
    element.tag = f"{{{NAMESPACES[kind]}}}{element.tag}"
    for child in element.iterchildren(etree.Element):
        _put_into_namespace(child, inner)


def validate(root: Any, kind: str, where: str) -> None:
    """Check an element against the published schema of its kind, as fmpy ships it.

    Raises
    ------
    SspError
        If it is not valid; the sentence gives the first violation.
    """
    import fmpy.ssp

    name = NAMESPACES[kind].rpartition("/")[2]
    schema = etree.XMLSchema(file=str(Path(fmpy.ssp.__file__).parent / "schema" / f"{name}.xsd"))
    if not schema.validate(root):
        first = schema.error_log[0]
        text = str(first.message)
        for uri in NAMESPACES.values():
            text = text.replace(f"{{{uri}}}", "")
        raise SspError(said("ssp.schema", where=where, first=first, text=text[:400].rstrip(".")))


_DOCUMENTS = (SSD_NAME, "resources/parameters.ssv", "resources/parameters.ssm")
_CONNECTOR_KINDS = ("input", "output", "parameter", "calculatedParameter")


def write_ssp(
    wiring: Wiring,
    path: str | os.PathLike[str],
    *,
    parameter_names: Mapping[Endpoint, str] | None = None,
    stop_time: float | None = None,
    replace: bool = False,
) -> Path:
    """Write a system as an SSP 1.0 file, its XML checked by the published schemas.

    Parameters
    ----------
    wiring : Wiring
        The system.
    path : path-like
        Where to write, with the suffix .ssp.
    parameter_names : mapping of Endpoint to str, optional
        What parameters are called in the parameter set; by default `component.variable`.
    stop_time : float, optional
        End of the default experiment [s].
    replace : bool
        Whether an existing file may be replaced.

    Raises
    ------
    SspError
        If a name cannot be written or is there twice, the path has another suffix, or something is there and
        `replace` is False.
    reporting.errors.FileNotWrittenError
        If the file cannot be written.
    """
    target = checked_target(path, replace=replace, file_kind="An SSP file", suffix=".ssp", error=SspError)
    structure, units = wiring.structure, _known_units(wiring)
    ends = (end for link in structure.connections for end in (link.source, link.target))
    used = {end: wiring.variable(end) for end in ends if end.component}
    for variable in used.values():
        if variable.causality not in _CONNECTOR_KINDS:
            raise SspError(said("ssp.causality", variable=variable))
    values = {
        "structure": structure,
        "wiring": wiring,
        "used": used,
        "parameters": _parameters(wiring, parameter_names or {}, units),
        "units": units,
        "stop_time": None if stop_time is None else float(stop_time),
        "implementations": {interface: name for name, interface in INTERFACES.items()},
        "resource": _resource,
        "namespaces": NAMESPACES,
        "own_namespace": OWN_NAMESPACE,
        "tool": f"uav-twin {version('uav-twin')}",
    }
    members = {name: rendered(Path(name).name, **values) for name in _DOCUMENTS}
    for name, content in members.items():
        validate(parse_xml(content, name), name[-3:], name)
    members |= {_resource(component.name): component.fmu.read_bytes() for component in structure.components}
    return atomic_write_bytes(target, archive_bytes(members, SSD_NAME))


def _resource(component: str) -> str:
    plain = component.replace(".", "_")
    if not plain.replace("_", "").replace("-", "").isalnum() or not plain.isascii():
        raise SspError(f"The component {component!r} needs a name of ASCII letters, digits, `_` and `-`.")
    return f"resources/{plain}.fmu"


def _known_units(wiring: Wiring) -> dict[str, dict[str, float]]:
    """Return the units that can be written: with exponents, and meaning the same in all FMUs."""
    found: dict[str, list[dict[str, float]]] = {}
    of_fmus = (unit for fmu in wiring.declared.values() for unit in fmu.units)
    for unit in (*wiring.structure.units, *of_fmus):
        if unit.exponents is None:
            continue
        base: dict[str, float] = {s: n for s, n in zip(BASE_UNITS, unit.exponents, strict=True) if n}
        if (unit.factor, unit.offset) != (1.0, 0.0):
            base |= {"factor": unit.factor, "offset": unit.offset}
        if base not in found.setdefault(unit.name, []):
            found[unit.name].append(base)
    return {name: bases[0] for name, bases in sorted(found.items()) if len(bases) == 1}


def _parameters(
    wiring: Wiring, names: Mapping[Endpoint, str], units: Mapping[str, object]
) -> list[dict[str, Any]]:
    """Return the parameters, in the FMUs' own units: no conversion stands between file and value."""
    found: dict[str, dict[str, Any]] = {}
    for component, values in wiring.settings.items():
        for variable_name, value in sorted(values.items()):
            end = Endpoint(component, variable_name)
            variable = wiring.variable(end)
            name, kind = names.get(end, str(end)), variable.base_type
            if name in found:
                raise SspError(said("ssp.parameter", name=name))
            text = value if isinstance(value, str) else _written(end, variable, value)
            unit = variable.unit if kind == "Real" and variable.unit in units else None
            found[name] = {"name": name, "end": end, "type": kind, "value": text, "unit": unit}
    return list(found.values())


def _written(end: Endpoint, variable: VariableInfo, value: float) -> str:
    """Return the text of a number in a parameter set; that of an enumeration is the name of its item."""
    if variable.base_type == "Real":
        return repr(value)
    if variable.base_type == "Boolean":
        return "true" if value else "false"
    if variable.base_type == "Integer":
        return str(int(value))
    for name, item in variable.items.items():
        if item == value:
            return name
    raise SspError(f"{end} = {value:g} is no item of its enumeration.")
