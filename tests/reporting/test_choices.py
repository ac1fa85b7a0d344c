"""Arguments that are one of a few words."""

import inspect
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Literal, NamedTuple, Unpack, get_args, get_origin, get_type_hints

import numpy as np
import pytest
import xarray
from matplotlib.axes import Axes

import uav_twin
from calibration.dynamics.modal_identification import identify_modes
from calibration.wing.lab_data import read_lab_folder
from fmu_asset.client.binding import Binding
from fmu_asset.compiled.cross_compiler import cross_compile_library
from fmu_asset.compiled.package import compiled_binaries, fmi_headers
from reporting.choices import require_one_of
from reporting.errors import InvalidChoiceError


def test_a_word_that_is_not_allowed_is_told_beside_the_nearest():
    with pytest.raises(
        InvalidChoiceError,
        match=r"`kind` must be 'ambient' or 'decay', but 'Decai' was given; .*'decay'",
    ):
        require_one_of("Decai", ("ambient", "decay"), "kind")


@pytest.mark.parametrize("value", [None, True, 1.0, "2", ["ambient"], np.array(["ambient"])])
def test_what_only_equals_an_allowed_value_is_refused(value):
    with pytest.raises(InvalidChoiceError, match="must be"):
        require_one_of(value, (1, "ambient"), "version")


def test_an_unknown_kind_of_record_is_not_taken_for_a_decay():
    with pytest.raises(
        InvalidChoiceError, match=r"'ambient' or 'decay', but 'free decay' was given"
    ):
        identify_modes(np.zeros((2000, 1)), 100.0, [[1.0, 5.0]], "free decay")


class Choice(NamedTuple):
    """An argument of the public interface with its allowed values."""

    owner: str
    argument: str
    values: tuple[object, ...]


def literal_values(hint: object) -> Iterator[tuple[object, ...]]:
    """Yield the values of each `Literal` inside a type hint."""
    if get_origin(hint) is Literal:
        yield get_args(hint)
    for part in get_args(hint):
        yield from literal_values(part)


def arguments(function: object) -> dict[str, object]:
    """Return the type hints of a function's arguments, of a TypedDict of options one by one."""
    # imported for type checkers alone where it takes long
    modules = {"xr": xarray, "Axes": Axes, "Sequence": Sequence}
    hints = get_type_hints(function, localns=modules)
    hints.pop("return", None)
    options = hints.get("options")
    if get_origin(options) is Unpack:
        hints |= get_type_hints(get_args(options)[0])
    return hints


def public_functions() -> Iterator[tuple[str, object]]:
    """Yield all functions, constructors and methods of `uav_twin.__all__` by name."""
    for name in uav_twin.__all__:
        value = getattr(uav_twin, name)
        if inspect.isfunction(value):
            yield name, value
        if inspect.isclass(value):
            for member, function in inspect.getmembers(value, inspect.isfunction):
                # pydantic gives sections methods, such as `copy`, whose hints it does not import
                is_of_pydantic = function.__module__.startswith("pydantic.")
                is_public = member == "__init__" or not member.startswith("_")
                if is_public and not is_of_pydantic:
                    yield f"{name}.{member}", function


CHOICES = [
    Choice(owner, argument, values)
    for owner, function in public_functions()
    for argument, hint in arguments(function).items()
    for values in literal_values(hint)
]

CALLS = {
    "GaussianSensorModel.__init__": partial(
        uav_twin.GaussianSensorModel, np.zeros((1, 2, 1, 1)), 1.0
    ),
    "Twin.__init__": partial(uav_twin.Twin, "twin", None, None, None),
    "build_fmu": partial(uav_twin.build_fmu, None, "never_written.fmu"),
    "calibrate": uav_twin.calibrate,
    "identify_modes": partial(uav_twin.identify_modes, np.zeros((2000, 1)), 100.0, [[1.0, 5.0]]),
}
"""Calls of the public interface that lack only an argument of few values.

A function with such an argument that is missing here fails the test below: add its call.
"""


@pytest.mark.parametrize("choice", CHOICES, ids=lambda choice: f"{choice.owner} {choice.argument}")
def test_every_public_argument_of_few_values_refuses_another(choice):
    wrong = ("amiga",) if choice.argument == "platforms" else "amiga"
    with pytest.raises(
        InvalidChoiceError, match=f"`{choice.argument}` must be .*'amiga' was given"
    ):
        CALLS[choice.owner](**{choice.argument: wrong})


def test_the_sweep_finds_the_arguments_of_options_too():
    assert {"kind", "fmi", "interface", "platforms"} <= {choice.argument for choice in CHOICES}


@pytest.mark.parametrize("key", ["fmi_version", "interface", "interpolation", "state"])
def test_a_binding_takes_no_other_word_in_its_header(key):
    binding = Binding.model_validate({"binding": {"name": "rig", "step_size": 0.1}})
    with pytest.raises(InvalidChoiceError, match=f"`{key}` must be"):
        binding.with_header(**{key: "replayed"})


@pytest.mark.parametrize("call", [fmi_headers, partial(compiled_binaries, {}, "wing")])
def test_the_parts_of_a_compiled_fmu_know_two_versions_of_fmi(call):
    with pytest.raises(InvalidChoiceError, match=r"`fmi` must be 2 or 3, but 1 was given"):
        call(fmi=1)


def test_a_library_is_compiled_for_no_unknown_target():
    with pytest.raises(
        InvalidChoiceError, match=r"'x86_64-window' was given; the nearest is 'x86_64-windows'"
    ):
        cross_compile_library({}, ["x86_64-window"])


def test_figures_of_a_laboratory_are_measured_or_published(tmp_path):
    with pytest.raises(InvalidChoiceError, match=r"`targets` must be 'measured' or 'published'"):
        read_lab_folder(tmp_path, "measurement")
