from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from twin_master.assets.strain_library_source import load_strain_library
from twin_master.errors import InvalidStrainLibraryError

LIBRARY = Path(__file__).parents[3].parent / "shared" / "reference" / "uav_digital_twin"
needs_library = pytest.mark.skipif(
    not LIBRARY.exists(), reason="the authors' strain library is not on this machine"
)


def small_content():
    """A library in the published format: strain is (100 + z1/2 + z2/10) * load factor / e, three gauges."""
    levels, controls, draws = [[0, 20, 40], [0, 50]], ["2g", "3g"], ["mean", "0.99", "1.01"]
    observations = {}
    for z1 in levels[0]:
        for z2 in levels[1]:
            for control in controls:
                for draw in draws:
                    factor = 1.0 if draw == "mean" else float(draw)
                    base = (100 + 0.5 * z1 + 0.1 * z2) * int(control[0]) / factor
                    cell = observations.setdefault(str(z1), {}).setdefault(str(z2), {})
                    cell.setdefault(control, {})[draw] = [base, 2 * base, 3 * base]
    return {
        "states": levels,
        "controls": controls,
        "gamma": 0.6,
        "transition_probabilities": {"2g": 0.05, "3g": 0.1},
        "observations": observations,
    }


def write(path, content):
    path.write_text(json.dumps(content), encoding="utf-8")
    return path


def test_published_format(tmp_path):
    library = load_strain_library(write(tmp_path / "UAVconfig.json", small_content()))
    assert library.controls == ("2g", "3g")
    assert library.states.shape == (3, 2)
    np.testing.assert_allclose(library.states.coordinates[-1], [0.4, 0.5])
    assert library.strain.shape == (6, 2, 3)
    assert library.strain_per_draw.shape == (2, 6, 2, 3)
    assert library.gauge_count == 3
    np.testing.assert_array_equal(library.young_modulus_factor, [0.99, 1.01])
    state = library.states.index((0.4, 0.5))
    np.testing.assert_allclose(library.strain[state, 1], np.array([1, 2, 3]) * 375e-6)
    np.testing.assert_allclose(library.strain_per_draw[0, state, 1], np.array([1, 2, 3]) * 375e-6 / 0.99)
    assert library.discount == 0.6
    assert library.worsening_probability == {"2g": 0.05, "3g": 0.1}
    by_folder = load_strain_library(tmp_path)
    np.testing.assert_array_equal(by_folder.strain, library.strain)


def test_between_the_levels_strain_is_multilinear(tmp_path):
    library = load_strain_library(write(tmp_path / "UAVconfig.json", small_content()))
    for z1, z2 in [(0.0, 0.0), (0.4, 0.5), (0.2, 0.0), (0.07, 0.21), (0.39, 0.5)]:
        expected = (100 + 50 * z1 + 10 * z2) * 3e-6 * np.array([1, 2, 3])
        np.testing.assert_allclose(library.strain_at((z1, z2), 1), expected, rtol=1e-13)
    for bad in [(0.41, 0.0), (-0.01, 0.0), (np.nan, 0.0)]:
        with pytest.raises(InvalidStrainLibraryError, match=r"covers z1 from 0 to 0\.4"):
            library.strain_at(bad, 0)
    with pytest.raises(InvalidStrainLibraryError, match="control index below 2"):
        library.strain_at((0.0, 0.0), 2)
    with pytest.raises(InvalidStrainLibraryError, match="one stiffness loss for each"):
        library.strain_at((0.0,), 0)


def _drop(key):
    def change(content):
        del content[key]

    return change


def _short_row(content):
    content["observations"]["20"]["0"]["3g"]["0.99"].pop()


def _no_number(content):
    content["observations"]["20"]["0"]["3g"]["mean"][1] = float("nan")


def _missing_state(content):
    del content["observations"]["40"]


def _one_region(content):
    content["states"].pop()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_drop("observations"), "lacks the entry 'observations'"),
        (_drop("gamma"), "lacks the entry 'gamma'"),
        (_missing_state, "lacks the entry '40'"),
        (_short_row, r"observations\[20\]\[0\]\[3g\]\[0.99\] must hold 3 finite"),
        (_no_number, "NaN is no number in JSON"),
        (_one_region, "levels of 2 regions"),
    ],
)
def test_an_incomplete_library_is_refused(tmp_path, change, message):
    content = small_content()
    change(content)
    with pytest.raises(InvalidStrainLibraryError, match=message):
        load_strain_library(write(tmp_path / "UAVconfig.json", content))


def test_a_missing_or_damaged_file_is_refused(tmp_path):
    with pytest.raises(InvalidStrainLibraryError, match="cannot be read"):
        load_strain_library(tmp_path)
    (tmp_path / "UAVconfig.json").write_text('{"states": [[0', encoding="utf-8")
    with pytest.raises(InvalidStrainLibraryError, match="is not valid JSON"):
        load_strain_library(tmp_path)
    (tmp_path / "UAVconfig.json").write_text("[1, 2]", encoding="utf-8")
    with pytest.raises(InvalidStrainLibraryError, match="not in the published format"):
        load_strain_library(tmp_path)


@pytest.fixture(scope="module")
def library():
    return load_strain_library(LIBRARY)


@needs_library
class TestAuthorsLibrary:
    """What is known of the published library, each fact checked."""

    def test_size(self, library):
        assert library.strain_per_draw.shape == (30, 25, 2, 24)
        assert library.discount == 0.6
        assert library.worsening_probability == {"2g": 0.05, "3g": 0.1}

    def test_gauge_16_carries_the_maximum_everywhere(self, library):
        assert np.all(library.strain.argmax(axis=2) == 16)
        assert np.all(library.strain_per_draw.argmax(axis=3) == 16)
        states = [library.states.index((z, 0.0)) for z in (0.0, 0.2, 0.4, 0.6, 0.8)]
        largest = library.strain_per_draw.mean(axis=0)[states, library.controls.index("3g"), 16]
        np.testing.assert_allclose(largest, np.array([3013, 3278, 3621, 4093, 4795]) * 1e-6, atol=1e-6)
