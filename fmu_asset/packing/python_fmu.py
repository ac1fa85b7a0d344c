"""The files of an FMU that runs in Python: a slave of ours, joined with pythonfmu's base class."""

from collections.abc import Mapping

from fmu_asset.description import PLACEHOLDER, Declaration, documentation_page, model_description

from .contents import BASE_CLASS_FILES, pythonfmu_members, pythonfmu_version, room_members

_SCRIPT = '''"""Loaded by the FMI wrapper; everything is in the package beside it."""
from {module}_runtime.entry import Fmi2Slave, Slave, keep_alive

# The wrapper runs this file once for each instance and drops one reference to its globals too many.
keep_alive(globals())


class {class_name}(Slave, Fmi2Slave):
    """The FMU."""

    content_tag = "{tag}"
'''

_ENTRY = '''"""Joins the slave, its contents and pythonfmu's base class."""
import ctypes

from .pythonfmu.fmi2slave import Fmi2Slave
from .slaves.base import Slave as _Slave
{imports}

__all__ = ["Fmi2Slave", "Slave", "keep_alive"]

_contents = []


def keep_alive(thing):
    """Hold one more reference for ever, also while the interpreter shuts down and clears this module."""
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(thing))


def load_once(resources):
    """Read the contents once in a process: this package's name is a hash of them."""
    if not _contents:
        _contents.append(load_contents(resources))
    return _contents[0]


class Slave(_Slave):
    """The slave with its resources."""

    load_contents = staticmethod(load_once)
'''


def python_members(
    declared: Declaration,
    class_name: str,
    *,
    imports: str,
    resources: Mapping[str, bytes],
    host: str = "It runs in a Python host that has NumPy.",
) -> dict[str, bytes]:
    """Return the files of the archive, with the placeholder wherever the content hash will stand.

    Parameters
    ----------
    declared : Declaration
        The model.
    class_name : str
        Of the class in the FMU's script, to which the tag is added.
    imports : str
        Lines that import `load_contents` into the runtime's package.
    resources : mapping of str to bytes
        What `load_contents` reads, by its names.
    host : str
        What the FMU runs in, for its documentation.
    """
    module = declared.identifier
    runtime = f"resources/{module}_runtime"
    script = _SCRIPT.format(module=module, class_name=f"{class_name}{PLACEHOLDER}", tag=PLACEHOLDER)
    tool = f"uav-twin with PythonFMU {pythonfmu_version()}"
    return {
        "modelDescription.xml": model_description(declared, generation_tool=tool),
        "documentation/index.html": documentation_page(declared, host),
        **{f"resources/{file}": content for file, content in resources.items()},
        f"resources/{module}.py": script.encode(),
        f"{runtime}/__init__.py": b'"""An FMU of uav-twin."""\n',
        f"{runtime}/entry.py": _ENTRY.format(imports=imports).encode(),
        f"{runtime}/pythonfmu/__init__.py": b'"""The base class of pythonfmu."""\n',
        **room_members("fmu_asset.slaves", f"{runtime}/slaves"),
        **pythonfmu_members(module, f"{runtime}/pythonfmu", BASE_CLASS_FILES),
    }
