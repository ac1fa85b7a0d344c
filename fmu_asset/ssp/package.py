"""The SSP archive: checked before it is used, its XML valid by the schemas, in the words of SSP 1.0."""

import os
import posixpath
import zipfile
import zlib
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from lxml import etree

from fmu_asset.archive.fmu_file import check_archive
from fmu_asset.errors import FmuFileError, SspError, said
from fmu_asset.instances.plan import Interface

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
