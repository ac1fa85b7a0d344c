"""`uav-twin ssp` and `uav-twin run x.ssp` as a user calls them."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from uav_twin import cli

HERE = Path(__file__).parents[1] / "twin_master" / "assets" / "heat_exchanger"


def call(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr(sys, "argv", ["uav-twin", *arguments])
    monkeypatch.setenv("COLUMNS", "200")
    with pytest.raises(SystemExit) as caught:
        cli.main()
    code = caught.value.code
    return 0 if code is None else int(code)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("ssp")
    for path in HERE.iterdir():
        if path.is_file():
            shutil.copy(path, place)
    subprocess.run(
        [sys.executable, "-m", "pythonfmu", "build", "-f", "HeatExchanger.py"],
        cwd=place, check=True, capture_output=True,
    )  # fmt: skip
    return place


def test_export_check_and_run(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], folder: Path, tmp_path: Path
) -> None:
    monkeypatch.setattr("twin_master.workflow._report", lambda folder: (folder / "report.html").touch())
    scenario, ssp, out = str(folder / "fouling.toml"), str(tmp_path / "x.ssp"), str(tmp_path / "run")
    assert call(monkeypatch, "ssp", "export", scenario, "--out", ssp) == 0
    assert "x.ssp: " in capsys.readouterr().out
    assert call(monkeypatch, "ssp", "check", ssp) == 0
    text = capsys.readouterr().out
    assert "no problem found; 8 connections, 2 parameters" in text
    assert "evaluated in the order heat_exchanger (HeatExchanger)" in text
    assert call(monkeypatch, "ssp", "export", scenario, "--out", ssp) == 1
    assert "exists: choose another --out or give --replace" in capsys.readouterr().err
    assert call(monkeypatch, "run", ssp, "--scenario", scenario, "--out", out, "--in-process", "-q") == 0
    assert (Path(out) / "asset" / "system.ssp").read_bytes() == Path(ssp).read_bytes()
    assert (Path(out) / "csv" / "observed.csv").is_file()


def test_bad_calls_are_one_sentence(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], folder: Path, tmp_path: Path
) -> None:
    scenario = str(folder / "fouling.toml")
    bad = tmp_path / "bad.ssp"
    bad.write_bytes(b"nothing")
    out = str(tmp_path / "x.ssp")
    for arguments, code, words in (
        (("ssp", "check", str(tmp_path / "none.ssp")), 1, "There is no SSP file"),
        (("ssp", "check", str(bad)), 1, "not a sound SSP archive"),
        (("ssp", "export", "no_scenario", "--out", out), 1, "There is no scenario `no_scenario`"),
        (("ssp", "export", scenario, "--out", str(tmp_path / "x.zip")), 1, "must have the suffix .ssp"),
        (("run", str(bad), "--scenario", scenario, "--out", out + "d"), 1, "not a sound SSP archive"),
        (("run", str(bad)), 2, "name a scenario as well"),
        (("run", scenario, "--scenario", scenario), 2, "belongs to an SSP file"),
    ):
        assert call(monkeypatch, *arguments) == code
        error = capsys.readouterr().err
        assert words in " ".join(error.split())
        if code == 1:
            assert len(error.strip().splitlines()) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["bad.ssp"]


def test_a_strain_library_cannot_be_exported(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    folder: Path,
    library_file: Path,
    tmp_path: Path,
) -> None:
    from scenarios import scenario_files

    text = scenario_files()["level_turns"].read_text(encoding="utf-8")
    flown, after = text.index("[asset]"), text.index("[calibration]")
    library = f'[asset]\nkind = "strain_library"\nfile = "{library_file}"\n\n[belief]\nkind = "asset"\n\n'
    text = text[:flown] + library + text[after:]
    path = tmp_path / "library.toml"
    path.write_text(text, encoding="utf-8")
    assert call(monkeypatch, "ssp", "export", str(path), "--out", str(tmp_path / "x.ssp")) == 1
    assert "only FMUs can be exported" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.xdist_group("wing")
def test_the_wing_of_a_design(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    ssp = str(tmp_path / "wing.ssp")
    assert call(monkeypatch, "ssp", "export", "uav_wing", "--out", ssp) == 0
    assert call(monkeypatch, "ssp", "check", ssp) == 0
    assert "evaluated in the order uav_wing (uav_wing)" in capsys.readouterr().out
