"""`uav-twin wing verify`: what it says and how it ends."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from fe.wing.design import load_design
from fe.wing.operators import assemble
from tests import command_line
from uav_twin import wing as command
from uav_twin.wing import Check


def call(monkeypatch: pytest.MonkeyPatch, *words: object) -> int:
    return command_line.call(monkeypatch, "wing", *words)


def checks_of(monkeypatch: pytest.MonkeyPatch, *checks: Check) -> None:
    def given(*_: object, **__: object) -> list[Check]:
        return list(checks)

    monkeypatch.setattr(command, "all_checks", given)


def test_checks_are_listed_and_kept(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    checks_of(monkeypatch, Check("patch test", "strain", 1e-15, 1e-12), Check("mesh", "order", float("nan")))
    assert call(monkeypatch, "verify", "--out", str(tmp_path / "out")) == 0
    text = capsys.readouterr().out
    assert "patch test" in text
    assert "kept" in text
    record = json.loads((tmp_path / "out" / "verification.json").read_text())
    assert [check["passed"] for check in record["checks"]] == [True, True]
    assert record["checks"][1]["value"] is None
    assert record["design_hash"] == load_design().hash
    assert call(monkeypatch, "verify", "--out", str(tmp_path / "out")) == 1
    assert "not an empty folder" in capsys.readouterr().err.replace("\n", " ")


def test_a_broken_limit_is_told_and_ends_with_1(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    checks_of(monkeypatch, Check("wing", "mass", 1e-3, 1e-10), Check("wing", "energy", float("nan"), 1e-5))
    assert call(monkeypatch, "verify") == 1
    captured = capsys.readouterr()
    assert captured.out.count("BROKEN") == 2
    assert "2 of 2 checks broke their limit: wing, mass; wing, energy." in captured.err


def test_wrong_calls(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert call(monkeypatch, "verify", "--design", str(tmp_path / "no.toml")) == 1
    assert "no.toml" in capsys.readouterr().err.replace("\n", "")
    assert call(monkeypatch, "--design", str(tmp_path / "no.toml"), "verify") == 2
    assert "behind the command" in capsys.readouterr().err
    assert call(monkeypatch, "nonsense") == 2


def test_every_check_of_the_elements_and_of_a_coarse_wing_is_kept() -> None:
    design = load_design().changed(mesh={"refinement": 0.25})
    checks = [*command.element_checks(), *command.balance_checks(assemble(design))]
    assert {check.group for check in checks} == {
        "patch test",
        "unsupported body",
        "cantilever",
        "MacNeal-Harder",
        "wing",
    }
    assert all(check.limit is not None for check in checks)
    assert [check.name for check in checks if not check.passed] == []


def test_convergence_names_every_gauge() -> None:
    # Three coarse meshes: the names and the kind of figures, not their size.
    design = load_design().changed(mesh={"refinement": 0.25})
    checks = list(command.convergence_checks(design, (0.25, 0.3, 0.36), limited=False))
    names = [check.name for check in checks]
    assert names[:3] == ["tip stiffness", "first bending", "second bending"]
    assert [name for name in names if name.startswith("gauge ")] == [f"gauge {n}" for n in range(1, 25)]
    assert all("order" in check.note or "monotone" in check.note for check in checks[:3])
