"""The files of an FMU that runs in Python: a slave of ours, joined with pythonfmu's base class."""

from collections.abc import Mapping

from fmu_asset.description import PLACEHOLDER, Declaration, documentation_page, model_description, rendered

from .contents import BASE_CLASS_FILES, pythonfmu_members, pythonfmu_version, room_members


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
    names = {"module": module, "class_name": f"{class_name}{PLACEHOLDER}", "tag": PLACEHOLDER}
    tool = f"uav-twin with PythonFMU {pythonfmu_version()}"
    return {
        "modelDescription.xml": model_description(declared, generation_tool=tool),
        "documentation/index.html": documentation_page(declared, host),
        **{f"resources/{file}": content for file, content in resources.items()},
        f"resources/{module}.py": rendered("slave.py", **names),
        f"{runtime}/__init__.py": b'"""An FMU of uav-twin."""\n',
        f"{runtime}/entry.py": rendered("entry.py", imports=imports),
        f"{runtime}/pythonfmu/__init__.py": b'"""The base class of pythonfmu."""\n',
        **room_members("fmu_asset.slaves", f"{runtime}/slaves"),
        **pythonfmu_members(module, f"{runtime}/pythonfmu", BASE_CLASS_FILES),
    }
