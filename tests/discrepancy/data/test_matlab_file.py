"""MATLAB files of version 5 to 7.3 as tables of a campaign."""

import h5py
import numpy as np
import pytest
from scipy.io import savemat

from discrepancy.campaign.importing import LaboratoryImport
from discrepancy.campaign.sheet import read_sheet
from discrepancy.errors import CampaignFileError

TIME = 0.01 * np.arange(12.0)
SWING = np.sin(TIME)


@pytest.fixture(params=[False, True], ids=["plain", "compressed"])
def sheet(request, tmp_path):
    """The sheet of a file with vectors, a matrix, a struct, and other values."""
    content = {
        "time": TIME[:, None],
        "acc": SWING,
        "w": np.stack([SWING, 2.0 * SWING], axis=1),
        "data": {"force": SWING.astype(np.float32), "on": SWING > 0.05},
        "rate": 100.0,
        "note": "a title",
        "image": np.zeros((40, 60)),
        "calibration": np.arange(3.0),
    }
    savemat(tmp_path / "lab.mat", content, do_compression=request.param)
    return read_sheet(tmp_path / "lab.mat")


def test_vectors_matrices_and_fields_of_structs_are_columns(sheet):
    assert sheet.heads == ("time", "acc", "w 1", "w 2", "data.force", "data.on")
    assert (sheet.units, sheet.decimal) == (("",) * 6, ".")


def test_numbers_of_a_column_have_all_digits_and_truths_are_one(sheet):
    numbers = [float(cell) for cell in sheet.numbers("w 2", ".")]
    np.testing.assert_array_equal(numbers, 2.0 * SWING)
    assert sheet.numbers("data.on", ".")[5:7] == ("0", "1")


def test_what_is_no_column_is_left_out_with_a_remark(sheet):
    left_out = "left out: 'rate', 'note', 'image' and 'calibration'"
    assert sheet.remark == f"rows 1 to 12 of 6 vectors; {left_out}"


def test_a_file_becomes_a_campaign_and_what_is_no_number_is_left_out(tmp_path):
    readings = SWING.copy()
    readings[3] = np.nan
    savemat(tmp_path / "lab.mat", {"data": {"time": TIME, "w": readings}})
    answers = {
        "kind": {"": "driven"},
        "unit": {"data.time": "s", "data.w": "mm"},
        "column": {"data.w": "w"},
    }
    campaign = LaboratoryImport([read_sheet(tmp_path / "lab.mat")], answers).campaign("lab")
    (trial,) = campaign.trials
    np.testing.assert_allclose(trial.time, TIME, rtol=1e-14)
    assert np.flatnonzero(~trial.used[:, 0]).tolist() == [3]
    np.testing.assert_allclose(trial.values[trial.used], 1e-3 * SWING[trial.used[:, 0]], rtol=1e-14)


def test_a_file_of_version_7_3_is_read(tmp_path):
    with h5py.File(tmp_path / "lab.mat", "w", userblock_size=512) as file:
        file["time"] = TIME[None, :]
        file["w"] = np.stack([SWING, 2.0 * SWING])  # MATLAB's 12 by 2, as it is stored
        note = file.create_dataset("note", data=np.array([[104, 105, 33]], dtype=np.uint16))
        note.attrs["MATLAB_class"] = np.bytes_("char")
        file["data/force"] = SWING[:, None]
        file["#refs#/a"] = SWING
    sheet = read_sheet(tmp_path / "lab.mat")
    assert sorted(sheet.heads) == ["data.force", "time", "w 1", "w 2"]
    np.testing.assert_array_equal([float(cell) for cell in sheet.numbers("w 2", ".")], 2.0 * SWING)
    assert sheet.remark.endswith("left out: 'note'")


def test_vectors_of_several_lengths_have_clocks_of_their_own(tmp_path):
    slow = {"time": TIME[::3], "value": SWING[::3]}
    savemat(tmp_path / "lab.mat", {"a": {"time": TIME, "value": SWING}, "b": slow, "x": np.arange(5.0)})
    sheet = read_sheet(tmp_path / "lab.mat")
    assert sheet.heads == ("a.time", "a.value", "b.time", "b.value")
    units = {"a.time": "s", "b.time": "s", "a.value": "mm", "b.value": "mm"}
    answers = {"kind": {"": "driven"}, "unit": units, "column": {"a.value": "a", "b.value": "b"}}
    (trial,) = LaboratoryImport([sheet], answers).campaign("lab").trials
    assert trial.used.sum(axis=0).tolist() == [12, 4]
    np.testing.assert_allclose(trial.values[::3, 1], 1e-3 * SWING[::3], rtol=1e-12)


def test_what_is_no_table_is_refused_in_one_sentence(tmp_path):
    path = tmp_path / "lab.mat"
    savemat(path, {"note": "a title", "c": np.array([1.0 + 2.0j, 3.0])})
    with pytest.raises(CampaignFileError, match=r"holds no vectors of numbers \(it has 'note' and 'c'\)"):
        read_sheet(path)
    savemat(path, {"t": TIME, "w": SWING})
    whole = path.read_bytes()
    for content in (b"", b"\x00\x01", whole[:200], whole[:150] + bytes(40) + whole[190:]):
        path.write_bytes(content)
        with pytest.raises(CampaignFileError, match=r"lab\.mat") as caught:
            read_sheet(path)
        assert "\n" not in str(caught.value)
