"""The SSP archive: checked before it is used, packed to the same bytes, its XML valid by the schemas."""

import os
import posixpath
import zipfile
import zlib
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from lxml import etree

from fmu_asset.archive.fmu_file import check_archive
from fmu_asset.errors import FmuFileError, SspError
from fmu_asset.instances.plan import Interface

SSD_NAME = "SystemStructure.ssd"
NAMESPACES = {
    "ssc": "http://ssp-standard.org/SSP1/SystemStructureCommon",
    "ssd": "http://ssp-standard.org/SSP1/SystemStructureDescription",
    "ssv": "http://ssp-standard.org/SSP1/SystemStructureParameterValues",
    "ssm": "http://ssp-standard.org/SSP1/SystemStructureParameterMapping",
}
OWN_NAMESPACE = "urn:uav-twin:coupling"
"""Of the annotations that say what SSP 1.0 has no word for: delayed connections, several steps in one."""
SET_TYPE = "application/x-ssp-parameter-set"
MAPPING_TYPE = "application/x-ssp-parameter-mapping"
FMU_TYPE = "application/x-fmu-sharedlibrary"
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

_HOLD_COMMON = ("Units", "Enumerations", "Annotations", "MappingEntry")
"""Elements of parameter sets and mappings below which the common namespace begins."""
_SCHEMAS = {
    "ssd": "SystemStructureDescription.xsd",
    "ssv": "SystemStructureParameterValues.xsd",
    "ssm": "SystemStructureParameterMapping.xsd",
}


class SspPackage:
    """An SSP file that was checked: sound, safe, and with a system structure in it.

    Attributes
    ----------
    unused : list of str
        Names of parameters, gathered by those who read: what the file sets and nothing takes.

    Raises
    ------
    SspError
        If the file is missing, damaged or unsafe, or holds no system structure.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self.unused: list[str] = []
        if not self.path.is_file():
            raise SspError(
                f"There is no SSP file {self.path}; check the path, or write it with `uav-twin ssp export`."
            )
        try:
            self.names = check_archive(self.path, self.path.stat().st_size, "SSP", "export")
        except FmuFileError as error:
            raise SspError(error.sentence) from error
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
            raise SspError(
                f"{what} in {self.path} names the source {source!r}, which lies outside the archive; only "
                "files inside it are used."
            )
        if name not in self.names:
            raise SspError(f"{what} in {self.path} names the source {source!r}, which is not in the archive.")
        return name

    def parse(self, name: str, kind: str) -> Any:
        """Return the root element of an XML file of the archive, valid by the schema of its kind.

        Parameters
        ----------
        name : str
            The file.
        kind : {"ssd", "ssv", "ssm"}
            What it must be.
        """
        root = parse_xml(self.read(name), f"{name} in {self.path}")
        if not root.tag.startswith("{"):
            _put_into_namespace(root, kind)
        if str(root.get("version", "")).startswith("2."):
            in_words_of_1(root, f"{name} in {self.path}")
        validate(root, kind, f"{name} in {self.path}")
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
        raise SspError(
            f"{where} has a document type declaration, which SSP files have no need of; it was refused."
        )
    return root


def in_words_of_1(root: Any, where: str) -> None:
    """Put a document of SSP 2.0 into the words of SSP 1.0, which has the same namespaces and fewer of them.

    The numbers of FMI 3 become the two that 1.0 knows; what FMU they come from decides their size. Metadata
    and signatures are left out.

    Raises
    ------
    SspError
        If it has what 1.0 has no word for: clocks, arrays, structural parameters, a component without a
        source.
    """
    own = tuple(f"{{{uri}}}" for uri in NAMESPACES.values())
    for element in list(root.iter(etree.Element)):
        if not element.tag.startswith(own):
            continue
        namespace, _, name = element.tag.rpartition("}")
        if str(element.get("version", "")).startswith("2."):
            element.set("version", "1.0")
        if name in _LEFT_OUT_OF_2:
            element.getparent().remove(element)
        elif name in _NUMBERS_OF_2:
            element.tag = f"{namespace}}}{_NUMBERS_OF_2[name]}"
        missing = {"Clock": "a clock", "Dimension": "an array"}.get(name)
        if element.get("kind") in ("clock", "structuralParameter"):
            missing = f"a connector of the kind {element.get('kind')}"
        if name == "Component" and element.get("source") is None:
            missing = f"the component {element.get('name')!r} without a source"
        if missing:
            raise SspError(
                f"{where} is of SSP 2.0 and has {missing} (line {element.sourceline}), which is not "
                "supported; leave it out, or use what SSP 1.0 has."
            )


def _put_into_namespace(element: Any, kind: str) -> None:
    """Give the namespaces of SSP 1.0 to a document that some tools write without any."""
    inner = "ssc" if element.tag in _HOLD_COMMON else kind
    element.tag = tag(f"{kind}:{element.tag}")
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

    folder = Path(fmpy.ssp.__file__).parent / "schema"
    schema = etree.XMLSchema(file=str(folder / _SCHEMAS[kind]))
    if not schema.validate(root):
        first = schema.error_log[0]
        text = str(first.message)
        for uri in NAMESPACES.values():
            text = text.replace(f"{{{uri}}}", "")
        raise SspError(
            f"{where} is not valid by the schema of SSP 1.0 (line {first.line}): {text[:400].rstrip('.')}."
        )


def tag(name: str) -> str:
    """Return a tag such as `ssd:System` with its namespace."""
    kind, _, local = name.partition(":")
    return f"{{{NAMESPACES[kind]}}}{local}"
