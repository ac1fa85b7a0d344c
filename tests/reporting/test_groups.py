"""Files of groups are read by xarray, and written without it."""

import subprocess
import sys

import numpy as np
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st

from reporting.groups import Group, Variable, write_groups

SIZES = {"step": 4, "sensor": 3, "state": 2, "empty": 0}
_TYPES = ("f8", "f4", "i8", "i1", "U5")
_NAMES = st.text("abcxyz", min_size=1, max_size=6).map("v_{}".format)


@st.composite
def variables(draw: st.DrawFn, axes: tuple[str, ...]) -> Variable:
    """Draw a variable of some axes."""
    values = np.arange(np.prod([SIZES[axis] for axis in axes], dtype=int)) * draw(st.integers(1, 5))
    shaped = values.reshape([SIZES[axis] for axis in axes]).astype(draw(st.sampled_from(_TYPES)))
    attrs = {"units": "1", "long_name": draw(st.text("abc äµ", max_size=9))}
    return Variable(axes, shaped, attrs)


@st.composite
def group(draw: st.DrawFn) -> Group:
    """Draw a group: some axes have labels, others have coordinates beside them."""
    axes = st.lists(st.sampled_from(list(SIZES)), unique=True, max_size=3).map(tuple)
    told = draw(st.dictionaries(_NAMES, axes.flatmap(variables), min_size=1, max_size=4))
    used = {axis for variable in told.values() for axis in variable.dims}
    coords = {axis: draw(variables((axis,))) for axis in sorted(used) if draw(st.booleans())}
    beside = {f"w_{axis}": draw(variables((axis,))) for axis in sorted(used) if draw(st.booleans())}
    return Group(told, {**coords, **beside}, {"parameter": "e"} if draw(st.booleans()) else {})


@settings(max_examples=25)
@given(groups=st.dictionaries(st.sampled_from(["one", "two", "three"]), group(), min_size=1))
def test_xarray_reads_what_was_written(groups, tmp_path_factory):
    file, again = (tmp_path_factory.mktemp("groups") / "file.nc" for _ in range(2))
    attrs = {"title": "a tree", "seed": 7}
    write_groups(file, groups, attrs)
    write_groups(again, groups, attrs)
    assert file.read_bytes() == again.read_bytes()
    sets = {name: xr.Dataset(one.variables, one.coords, one.attrs) for name, one in groups.items()}
    with xr.open_datatree(file, engine="h5netcdf") as tree:
        xr.testing.assert_identical(
            tree.load(), xr.DataTree.from_dict({"/": xr.Dataset(attrs=attrs), **sets})
        )
        for name, one in groups.items():
            for key, variable in {**one.variables, **one.coords}.items():
                assert variable.values.dtype.kind == "U" or tree[name][key].dtype == variable.values.dtype


def test_a_run_is_flown_and_stored_without_heavy_libraries():
    """`uav-twin run --no-report` reads the program's modules and none of these."""
    code = (
        "import sys, twin_master.workflow, twin_master.assets.design_source\n"
        "import calibration.paper.load_test\n"
        "import calibration.static.errors_in_variables, calibration.static.experiments\n"
        "import calibration.static.posterior\n"
        "heavy = {'xarray', 'pandas', 'dask', 'distributed', 'zarr', 'matplotlib', 'bokeh', 'skfem', 'pymor',"
        " 'meshio', 'scipy.interpolate', 'scipy.optimize', 'scipy.sparse'}\n"
        "print(*sorted(heavy & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []
