"""`uav-twin fmu build`: kinds, versions and interfaces that fit together, and those that do not."""

from __future__ import annotations

import zipfile
from pathlib import Path

import pytest
from typer.testing import CliRunner

from uav_twin.cli import app


def test_the_version_and_interface_are_those_that_were_asked_for(tmp_path: Path) -> None:
    for options, expected in (
        (("--fmi", "3"), ('fmiVersion="3.0"', "<CoSimulation")),
        (("--interface", "model-exchange"), ('fmiVersion="2.0"', "<ModelExchange")),
    ):
        path = tmp_path / f"{options[1]}.fmu"
        done = CliRunner().invoke(app, ["fmu", "build", "--kind", "source", *options, "--out", str(path)])
        assert done.exit_code == 0, done.output
        with zipfile.ZipFile(path) as archive:
            text = archive.read("modelDescription.xml").decode()
        assert all(part in text for part in expected)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (("--fmi", "3"), "build the kind 'compiled' or 'source'"),
        (("--kind", "source", "--windows"), "--windows is for --kind compiled"),
        (("--fmi", "3", "--interface", "model-exchange"), "build the kind 'compiled' or 'source'"),
        (("--script", "gear_pump", "--fmi", "3"), "are for the wing"),
        (("--fmi", "4"), "less than or equal to 3"),
    ],
)
def test_what_does_not_fit_together_is_refused(
    tmp_path: Path, options: tuple[str, ...], sentence: str
) -> None:
    done = CliRunner().invoke(app, ["fmu", "build", *options, "--out", str(tmp_path / "w.fmu")])
    assert done.exit_code != 0
    assert sentence in " ".join(f"{done.output} {done.exception}".replace("│", "").split())
    assert not list(tmp_path.iterdir())
