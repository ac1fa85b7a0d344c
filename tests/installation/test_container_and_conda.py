"""The Dockerfile and the recipe of conda: they fit pyproject.toml, and are built where there is a tool."""

import re
import shutil
import subprocess
import tomllib
from fnmatch import fnmatch
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
NAMES_IN_CONDA = {"matplotlib": "matplotlib-base", "prometheus-client": "prometheus_client"}
"""Packages that conda calls otherwise; the first without a graphical interface."""
LONGEST_BUILD = 1200.0
"""Seconds."""


def requirements(recipe: str, table: str) -> set[str]:
    """Return the requirements of a table of the recipe, such as "numpy>=2.1"."""
    (block,) = re.findall(rf"^  {table}:\n((?:    - .*\n)+)", recipe, re.M)
    return {line.replace(" ", "").removeprefix("-") for line in block.splitlines()}


def copied_by_dockerfile() -> set[str]:
    dockerfile = (ROOT / "Dockerfile").read_text(encoding="utf-8")
    copied: set[str] = set()
    for line in re.findall(r"^COPY (.*)$", dockerfile, re.M):
        copied |= set(line.split()[:-1])
    return copied


def test_the_image_has_every_package_and_what_the_build_reads():
    patterns = PROJECT["tool"]["setuptools"]["packages"]["find"]["include"]
    packages = {path.parent.name for path in ROOT.glob("*/__init__.py")}
    distributed = {name for name in packages if any(fnmatch(name, pattern) for pattern in patterns)}
    files = {"requirements.lock", "pyproject.toml", PROJECT["project"]["readme"]}
    files |= set(PROJECT["project"]["license-files"])
    assert copied_by_dockerfile() == distributed | files


def test_nothing_that_the_image_copies_is_ignored():
    """The file ignores everything but what it names."""
    ignored = (ROOT / ".dockerignore").read_text(encoding="utf-8").splitlines()
    assert ignored[0] == "*"
    assert {line[1:] for line in ignored if line.startswith("!")} == copied_by_dockerfile()


def test_the_recipe_of_conda_has_the_requirements_of_the_package():
    recipe = (ROOT / "conda" / "meta.yaml").read_text(encoding="utf-8")
    project = PROJECT["project"]
    expected = {f"python{project['requires-python']}"}
    for requirement in (*project["dependencies"], *project["optional-dependencies"]["fast"]):
        name = re.match(r"[a-z0-9-]+", requirement)[0]
        expected.add(requirement.replace(name, NAMES_IN_CONDA.get(name, name), 1))
    assert requirements(recipe, "run") == expected
    assert f"\n  version: {project['version']}\n" in recipe
    (script,) = project["scripts"].items()
    assert f"    - {' = '.join(script)}\n" in recipe


def built(*command: str) -> None:
    subprocess.run(command, cwd=ROOT, check=True, timeout=LONGEST_BUILD)


def test_the_image_is_built_and_runs():
    if (
        shutil.which("docker") is None
        or subprocess.run(["docker", "info"], check=False, capture_output=True).returncode
    ):
        pytest.skip("needs Docker and its daemon, to build the image")
    built("docker", "build", "--quiet", "--tag", "uav-twin-test", ".")
    built("docker", "run", "--rm", "uav-twin-test", "scenario", "check", "level_turns")


def test_the_recipe_of_conda_is_built():
    if shutil.which("conda-build") is None:
        pytest.skip("needs conda-build, to build the recipe")
    built("conda", "build", "--channel", "conda-forge", "conda")
