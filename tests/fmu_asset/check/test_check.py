"""What the checks say of sound FMUs and of FMUs with one fault each."""

import pytest

from fmu_asset.archive.fmu_file import inspect_fmu
from fmu_asset.check import FmuCheck, check_file, check_fmu
from tests.fmu_asset.foreign.workshop import MODELS
from tests.fmu_asset.making import bound, tables

FAULTS = tables(__file__, "faults")
QUICK = ("array3", "ball2")


def verdicts(check: FmuCheck) -> dict[str, str]:
    return {finding.check: finding.verdict for finding in check.findings}


def texts(check: FmuCheck, name: str) -> str:
    return " ".join(finding.text for finding in check.findings if finding.check == name)


@pytest.mark.parametrize(
    "model", [name if name in QUICK else pytest.param(name, marks=pytest.mark.long) for name in MODELS]
)
def test_sound_fmus_of_all_kinds_have_no_problem(foreign_fmu, model) -> None:
    check = check_fmu(foreign_fmu(model), step_size=0.01 if model == "fixed2" else 0.1)
    assert check.passed, check.problems
    found = verdicts(check)
    assert found["determinism"] == "ok"
    assert found["state"] == ("ok" if model in ("fixed2", "array3", "hostile2") else "warning")
    # FMI 1.0 model exchange has no reset.
    assert found["reset"] == ("warning" if model == "decay1" else "ok")


@pytest.mark.parametrize(("what", "check", "sentence"), FAULTS["fault"])
def test_one_fault_is_one_problem(foreign_fmu, what, check, sentence) -> None:
    result = check_fmu(foreign_fmu("hostile2", what), step_timeout=1.0)
    assert not result.passed
    assert verdicts(result)[check] == "problem"
    assert sentence in texts(result, check)
    if check == "first flight":
        assert len(result.problems) == 1
        assert verdicts(result)["state"] == "skipped"


@pytest.mark.long
@pytest.mark.slow
def test_eighty_instances_in_one_process(foreign_fmu) -> None:
    """Create, run and free: the process does not grow, and one that leaks 256 KiB each is found out."""
    for what, cycles, verdict, sentence in (
        ((), 80, "ok", ""),
        (("LEAK_IN_FREE",), 60, "problem", "it leaks"),
        (("CRASH_IN_FREE",), 3, "problem", "Instance 1 of 3 in one process"),
    ):
        check = check_fmu(foreign_fmu("hostile2", *what), cycles=cycles)
        assert verdicts(check)["instances"] == verdict, texts(check, "instances")
        assert sentence in texts(check, "instances")


def test_step_sizes_and_units_that_contradict(foreign_fmu) -> None:
    for number, (model, options, changes, check, sentence) in enumerate(FAULTS["told"]):
        path = foreign_fmu.changed(model, f"told{number}", *changes)
        of_file = " ".join(text for name, _, text in check_file(inspect_fmu(path)[0]) if name == check)
        assert sentence in (of_file or texts(check_fmu(path, **options), check))
    broken = foreign_fmu.changed("fixed2", "schema", ('<Real start="0"/>', "<Real/>"))
    assert any("start value" in text for _, _, text in check_file(inspect_fmu(broken)[0]))


def test_a_range_that_the_fmu_does_not_keep(foreign_fmu) -> None:
    check = check_fmu(foreign_fmu("hostile2", "REFUSE", "AFTER=0"))
    assert check.passed
    assert "1 of 4 ends of ranges fail, such as u = 10 m/s" in texts(check, "range edges")
    assert "u is too large" in texts(check, "range edges")


def test_a_binding_with_other_sizes_is_checked_with_them(foreign_fmu) -> None:
    """Three inputs, for which the FMU has two start values."""
    sized = bound(
        1.0, {"y": ("y", "1")}, control={"u": ("u", "1")}, header={"structural_parameters": {"n": 3}}
    )
    check = check_fmu(foreign_fmu("resize3"), sized, cycles=2)
    assert "3 finite outputs" in texts(check, "first flight")
    found = verdicts(check)
    names = ("binding", "first flight", "determinism", "step size", "reset", "instances")
    assert [found[name] for name in names] == ["ok"] * 6
    assert found["state"] == "warning"
