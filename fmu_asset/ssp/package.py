"""SSP 1.0 archives: checked and read into XML that is valid by the schemas, and written.

SSP (System Structure and Parameterization) is the standard file format for systems of FMUs. Equal
systems give equal bytes.
"""

import os
import posixpath
import zipfile
import zlib
from pathlib import Path
from urllib.parse import unquote, urlsplit

from lxml import etree
from lxml.etree import _Element as XmlElement

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
"""The namespaces by kind of document; the last word is the name of its schema."""

OWN_NAMESPACE = "urn:uav-twin:coupling"
"""The namespace of our annotations for what SSP 1.0 lacks: delayed connections, substeps."""

OSP_NAMESPACE = "http://opensimulationplatform.com/SSP/OSPAnnotations"
"""The namespace of the annotation of the Open Simulation Platform with the step of a system."""

INTERFACES: dict[str, Interface | None] = {
    "any": None,
    "CoSimulation": "co-simulation",
    "ModelExchange": "model-exchange",
}

_SSP1_NUMBER_TYPES = {"Float32": "Real", "Float64": "Real"}
"""Types of numbers in SSP 1.0 by those of SSP 2.0."""
for _bits in (8, 16, 32, 64):
    _SSP1_NUMBER_TYPES[f"Int{_bits}"] = "Integer"
    _SSP1_NUMBER_TYPES[f"UInt{_bits}"] = "Integer"

_IGNORED_IN_SSP2 = ("MetaData", "Signature")

_UNSUPPORTED = {
    "Binary": "a binary connector",
    "Clock": "a clock",
    "Dimension": "an array",
    "SignalDictionaries": "signal dictionaries",
    "SignalDictionaryReference": "signal dictionaries",
    "BooleanMappingTransformation": "a BooleanMappingTransformation",
    "IntegerMappingTransformation": "a IntegerMappingTransformation",
    "EnumerationMappingTransformation": "a EnumerationMappingTransformation",
}
"""Elements that are not read, with their names in messages."""

_HOLD_COMMON_ELEMENTS = ("Units", "Enumerations", "Annotations", "MappingEntry")
"""Elements of parameter sets and mappings whose children are in the common namespace."""

_LONGEST_SCHEMA_MESSAGE = 400


class SspPackage:
    """An SSP file whose archive is sound and safe, and has a system structure.

    Attributes
    ----------
    names : set of str
        The files in the archive.

    Raises
    ------
    SspError
        If the file is missing, damaged or unsafe, or holds no system structure.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        if not self.path.is_file():
            raise SspError(
                f"There is no SSP file {self.path}; check the path, or write it with `uav-twin ssp "
                "export`."
            )
        size = self.path.stat().st_size
        with SspError.instead_of(FmuFileError):
            self.names = check_archive(self.path, size, archive_kind="SSP", remedy="export")
        if SSD_NAME not in self.names:
            raise SspError(
                f"{self.path} is an archive without {SSD_NAME}, so it is not an SSP file."
            )

    def read(self, name: str) -> bytes:
        """Return the content of a file in the archive."""
        try:
            with zipfile.ZipFile(self.path) as archive:
                return archive.read(name)
        except (OSError, KeyError, zipfile.BadZipFile, zlib.error) as error:
            raise SspError(f"{name} in {self.path} cannot be read ({error}).") from error

    def resolve(self, source: str, element_label: str) -> str:
        """Return the file in the archive to which a URI of the system structure refers.

        Parameters
        ----------
        element_label : str
            The element with the URI, for messages.

        Raises
        ------
        SspError
            If the URI leads outside the archive, or there is no such file in it.
        """
        parts = urlsplit(source)
        name = posixpath.normpath(unquote(parts.path))
        is_not_relative = parts.scheme or parts.netloc or parts.query or parts.fragment
        leads_outside = not parts.path or name.startswith(("/", "..")) or "\\" in name
        if is_not_relative or leads_outside:
            raise SspError(
                f"{element_label} in {self.path} names the source {source!r}, which lies outside "
                "the archive; only files inside it are used."
            )
        if name not in self.names:
            raise SspError(
                f"{element_label} in {self.path} names the source {source!r}, which is not in the "
                "archive."
            )
        return name

    def parse(self, kind: str, name: str, content: bytes | None = None) -> XmlElement:
        """Return the root element of an XML document, valid by the schema of its kind.

        Parameters
        ----------
        kind : {"ssd", "ssv", "ssm"}
            The kind of document that it must be.
        name : str
            The file in the archive, or the name of `content` in messages.
        content : bytes, optional
            The document; by default the content of the file.
        """
        label = f"{name} in {self.path}"
        root = parse_xml(self.read(name) if content is None else content, label)
        if not root.tag.startswith("{"):
            _add_namespaces(root, kind)
        _convert_to_ssp1(root, label)
        validate(root, kind, label)
        return root


def parse_xml(content: bytes, label: str) -> XmlElement:
    """Return the root of an XML text, without resolving entities or loading anything.

    Parameters
    ----------
    label : str
        The name of the text in messages.

    Raises
    ------
    SspError
        If the text is not well-formed, or has a document type declaration.
    """
    parser = etree.XMLParser(
        resolve_entities=False, no_network=True, load_dtd=False, huge_tree=False
    )
    try:
        root = etree.fromstring(content, parser)
    except etree.XMLSyntaxError as error:
        raise SspError(f"{label} is not well-formed XML ({error.msg}).") from error
    if root.getroottree().docinfo.doctype:
        raise SspError(
            f"{label} has a document type declaration, which SSP files have no need of; it was "
            "refused."
        )
    return root


def _convert_to_ssp1(root: XmlElement, label: str) -> None:
    """Convert an SSP 2.0 document to SSP 1.0, as far as it is read here, in place.

    SSP 2.0 has the same namespaces and more elements. The number types of FMI 3 become the two of
    SSP 1.0; the FMU that they belong to decides their size. Metadata and signatures are removed. An
    `SspError` is raised for an unsupported element.
    """
    for element in list(root.iter(etree.Element)):
        tag = etree.QName(element)
        if tag.namespace not in NAMESPACES.values():
            continue
        if str(element.get("version", "")).startswith("2."):
            element.set("version", "1.0")
        if tag.localname in _IGNORED_IN_SSP2:
            element.getparent().remove(element)
        elif tag.localname in _SSP1_NUMBER_TYPES:
            element.tag = f"{{{tag.namespace}}}{_SSP1_NUMBER_TYPES[tag.localname]}"
        unsupported = _unsupported_part(element, tag)
        if unsupported:
            raise SspError(
                f"{label} has {unsupported}, not supported (line {element.sourceline}); leave it "
                "out, or use direct connections, single numbers and linear transformations."
            )


def _unsupported_part(element: XmlElement, tag: etree.QName) -> str:
    """Return what is unsupported in an element, for a message; empty if nothing is."""
    if tag.localname == "Component" and element.get("source") is None:
        return f"the component {element.get('name')!r} without a source"
    if element.get("kind") in ("clock", "structuralParameter"):
        return f"a connector of the kind {element.get('kind')}"
    # A binary value of a parameter set is refused where something takes it.
    if tag.namespace == NAMESPACES["ssv"]:
        return ""
    return _UNSUPPORTED.get(tag.localname, "")


def _add_namespaces(element: XmlElement, kind: str) -> None:
    """Add the namespaces of SSP 1.0 to a document that some tools write without any."""
    kind_of_children = "ssc" if element.tag in _HOLD_COMMON_ELEMENTS else kind
    element.tag = f"{{{NAMESPACES[kind]}}}{element.tag}"
    for child in element.iterchildren(etree.Element):
        _add_namespaces(child, kind_of_children)


def validate(root: XmlElement, kind: str, label: str) -> None:
    """Check a document against the published schema of its kind, which fmpy ships.

    Parameters
    ----------
    kind : {"ssd", "ssv", "ssm"}
        The kind of document.
    label : str
        The name of the document in messages.

    Raises
    ------
    SspError
        If it is not valid; the message quotes the first violation.
    """
    import fmpy.ssp

    schema_name = NAMESPACES[kind].rpartition("/")[2]
    schema_file = Path(fmpy.ssp.__file__).parent / "schema" / f"{schema_name}.xsd"
    schema = etree.XMLSchema(file=str(schema_file))
    if schema.validate(root):
        return
    violation = schema.error_log[0]
    message = str(violation.message)
    for uri in NAMESPACES.values():
        message = message.replace(f"{{{uri}}}", "")
    message = message[:_LONGEST_SCHEMA_MESSAGE].rstrip(".")
    raise SspError(
        f"{label} is not valid by the schema of SSP 1.0 (line {violation.line}): {message}."
    )
