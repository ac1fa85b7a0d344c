import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from twin_master.assets.strain_library_source import StrainLibrary, load_strain_library
from twin_master.errors import MissionInputError

LEVELS = [[0, 20, 40], [0, 50]]


def strain(z1: float, z2: float, load: float, e: float = 1.0) -> np.ndarray:
    """What three gauges show, in microstrain."""
    return (100 + 0.5 * z1 + 0.1 * z2) * load / e * np.array([1.0, 2.0, 3.0])


def small_content(levels: list[list[int]] = LEVELS) -> dict[str, Any]:
    """A library in the published format."""
    draws = {"mean": 1.0, "0.99": 0.99, "1.01": 1.01}
    observations = {
        str(z1): {
            str(z2): {
                f"{load}g": {name: strain(z1, z2, load, e).tolist() for name, e in draws.items()}
                for load in (2, 3)
            }
            for z2 in levels[1]
        }
        for z1 in levels[0]
    }
    return {"states": levels, "controls": ["2g", "3g"], "observations": observations}


def loaded(folder: Path, content: object) -> StrainLibrary:
    (folder / "UAVconfig.json").write_text(
        content if isinstance(content, str) else json.dumps(content), encoding="utf-8"
    )
    return load_strain_library(folder)


def test_published_format(tmp_path):
    with pytest.raises(MissionInputError, match="cannot be read"):
        load_strain_library(tmp_path)
    library = loaded(tmp_path, small_content())
    assert library.controls == ("2g", "3g")
    assert library.states.shape == (3, 2)
    np.testing.assert_allclose(library.states.coordinates[-1], [0.4, 0.5])
    assert library.strain.shape == (6, 2, 3)
    assert library.strain_per_draw.shape == (2, 6, 2, 3)
    assert library.gauge_count == 3
    np.testing.assert_array_equal(library.young_modulus_factor, [0.99, 1.01])
    state = library.states.index((0.4, 0.5))
    np.testing.assert_allclose(library.strain[state, 1], 1e-6 * strain(40, 50, 3))
    np.testing.assert_allclose(library.strain_per_draw[0, state, 1], 1e-6 * strain(40, 50, 3, 0.99))
    by_file = load_strain_library(tmp_path / "UAVconfig.json")
    np.testing.assert_array_equal(by_file.strain, library.strain)


def test_between_the_levels_strain_is_multilinear(tmp_path):
    library = loaded(tmp_path, small_content())
    for z1, z2 in [(0.0, 0.0), (0.4, 0.5), (0.2, 0.0), (0.07, 0.21), (0.39, 0.5)]:
        expected = 1e-6 * strain(100 * z1, 100 * z2, 3)
        np.testing.assert_allclose(library.strain_at((z1, z2), 1), expected, rtol=1e-13)
    single = loaded(tmp_path, small_content([LEVELS[0], [0]]))  # of one region, as it were
    np.testing.assert_allclose(single.strain_at((0.07, 0.0), 1), 1e-6 * strain(7, 0, 3), rtol=1e-13)
    with pytest.raises(MissionInputError, match=r"covers z2 from 0 to 0, got 0\.1"):
        single.strain_at((0.07, 0.1), 1)
    for outside in (0.41, -0.01, np.nan):
        with pytest.raises(MissionInputError, match=r"covers z1 from 0 to 0\.4"):
            library.strain_at((outside, 0.0), 0)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda content: content.pop("observations"), "lacks the entry 'observations'"),
        (lambda content: content["observations"].pop("40"), "lacks the entry '40'"),
        (lambda content: cell(content, "0.99").pop(), r"\[20\]\[0\]\[3g\]\[0.99\] must hold 3 finite"),
        (lambda content: cell(content, "mean").__setitem__(1, float("nan")), "NaN is no number in JSON"),
        (lambda content: content.update(states=LEVELS[:1]), "levels of 2 regions"),
        (lambda _: '{"states": [[0', "not valid JSON"),
        (lambda _: "[1, 2]", "not in the published format"),
    ],
)
def test_an_incomplete_or_damaged_library_is_refused(tmp_path, change, sentence):
    content = small_content()
    damaged = change(content)
    with pytest.raises(MissionInputError, match=sentence):
        loaded(tmp_path, damaged if isinstance(damaged, str) else content)


def cell(content: dict[str, Any], draw: str) -> list[float]:
    return content["observations"]["20"]["0"]["3g"][draw]


def test_what_is_known_of_the_published_library(published_library):
    """Gauge 16 carries the maximum everywhere."""
    library = load_strain_library(published_library)
    assert library.strain_per_draw.shape == (30, 25, 2, 24)
    assert np.all(library.strain.argmax(axis=2) == 16)
    assert np.all(library.strain_per_draw.argmax(axis=3) == 16)
    states = [library.states.index((z, 0.0)) for z in (0.0, 0.2, 0.4, 0.6, 0.8)]
    largest = library.strain_per_draw.mean(axis=0)[states, library.controls.index("3g"), 16]
    np.testing.assert_allclose(largest, np.array([3013, 3278, 3621, 4093, 4795]) * 1e-6, atol=1e-6)
