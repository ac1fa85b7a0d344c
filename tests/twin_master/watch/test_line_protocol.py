"""Line protocol: lines of the published syntax, and whatever is written and read again."""

import math
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.refusals import Inputs
from twin_master.feeds.line_protocol import looks_like_line_protocol, parse_line, write_line
from twin_master.feeds.points import FieldValue, Point

INPUTS = Inputs(__file__)

# Written by hand from the published syntax: the line, and what it says.
ORACLES = {
    "a line of the reference": (
        'myMeasurement,tag1=value1,tag2=value2 fieldKey="fieldValue" 1556813561098000000',
        Point(
            "myMeasurement",
            {"fieldKey": "fieldValue"},
            {"tag1": "value1", "tag2": "value2"},
            1556813561098000000,
        ),
    ),
    "no tags and no time": ("wing strain_1=1e-4", Point("wing", {"strain_1": 1e-4})),
    "types of numbers": (
        "m a=1,b=1i,c=18446744073709551615u,d=-.5,e=-1.5E+2,f=3.",
        Point("m", {"a": 1.0, "b": 1, "c": 18446744073709551615, "d": -0.5, "e": -150.0, "f": 3.0}),
    ),
    "truth values": (
        "m a=t,b=T,c=true,d=True,e=TRUE,f=f,g=F,h=false,i=False,j=FALSE",
        Point("m", {**dict.fromkeys("abcde", True), **dict.fromkeys("fghij", False)}),
    ),
    "escapes in the measurement": (r"my\ Mea\,sure=ment a=1", Point("my Mea,sure=ment", {"a": 1.0})),
    "escapes in tags": (r"m,ta\=g\ K\,ey=va\ lu\,e\= a=1", Point("m", {"a": 1.0}, {"ta=g K,ey": "va lu,e="})),
    "escapes in the name of a field": (r"m f\ i\,e\=ld=1", Point("m", {"f i,e=ld": 1.0})),
    "escapes in a text": (r'm a="say \"C:\\x\", ok=1" 7', Point("m", {"a": r'say "C:\x", ok=1'}, {}, 7)),
    "a backslash before another character is itself": (
        r'm\n,t\a=b\c f\d=1,s="\e"',
        Point(r"m\n", {r"f\d": 1.0, "s": r"\e"}, {r"t\a": r"b\c"}),
    ),
    "an empty text and a negative time": ('m a="" -1', Point("m", {"a": ""}, {}, -1)),
    "letters beyond ASCII": ("Flügel,ort=Spitze größe=1i", Point("Flügel", {"größe": 1}, {"ort": "Spitze"})),
}


@pytest.mark.parametrize(("line", "expected"), ORACLES.values(), ids=ORACLES)
def test_a_line_of_the_published_syntax_is_read(line, expected):
    assert parse_line(line) == expected
    assert looks_like_line_protocol(line)


@pytest.mark.parametrize("line", ["", "   ", "# a comment, x=1", "\n"])
def test_empty_lines_and_comments_are_no_points(line):
    assert parse_line(line) is None


def test_a_value_that_is_not_a_number_is_read_as_such():
    """Publishers in Python write it so; a sensor with it is lost, and the others of the line count."""
    point = parse_line("m a=nan,b=-inf,c=1")
    assert point is not None
    assert math.isnan(point.fields["a"])
    assert (point.fields["b"], point.fields["c"]) == (-math.inf, 1.0)


@pytest.mark.parametrize(("line", "sentence"), INPUTS.refused("lines"))
def test_what_is_no_line_protocol_is_refused_with_its_column(line, sentence):
    with pytest.raises(ValueError, match=sentence) as caught:
        parse_line(line)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "text",
    [
        "step,control,strain_1",
        "strain_1 [microstrain],strain_2 [microstrain]",
        '{"a": "b =c"}',
        "garbage 12",
        "",
    ],
)
def test_csv_and_json_do_not_look_like_line_protocol(text):
    assert not looks_like_line_protocol(text)


def names(special: str) -> st.SearchStrategy[str]:
    """Return names that line protocol can express, rich in the characters that it escapes."""
    letters = st.sampled_from(special + '\\"#ab/ü') | st.characters(exclude_categories=["Cs", "Cc"])
    ambiguous = re.compile(rf"\\(?:[{re.escape(special)}]|\Z)")
    return st.text(letters, min_size=1, max_size=12).filter(lambda name: not ambiguous.search(name))


VALUES: st.SearchStrategy[FieldValue] = st.one_of(
    st.booleans(),
    st.integers(-(2**63), 2**64 - 1),
    st.floats(allow_nan=False),
    st.text(st.sampled_from('\\", =ab') | st.characters(exclude_categories=["Cs", "Cc"]), max_size=12),
)
POINTS = st.builds(
    Point,
    names(", ").filter(lambda name: not name.startswith(("#", " "))),
    st.dictionaries(names(",= "), VALUES, min_size=1, max_size=4),
    st.dictionaries(names(",= "), names(",= "), max_size=3),
    st.none() | st.integers(-(2**63), 2**63 - 1),
)


@given(POINTS)
def test_what_is_written_is_read_again(point):
    read = parse_line(write_line(point))
    assert read == point
    assert [type(value) for value in read.fields.values()] == [type(value) for value in point.fields.values()]


@given(st.text(st.sampled_from('m,= \\"12iut.e-\n#') | st.characters(), max_size=40))
def test_any_text_is_a_point_or_refused(text):
    """A publisher can send anything; nothing but a ValueError comes of it, and no point without fields."""
    try:
        point = parse_line(text)
    except ValueError:
        return
    assert point is None or point.fields


@pytest.mark.parametrize("name", ["", "ends\\", "before\\,comma", "two\nlines"])
def test_a_name_that_line_protocol_cannot_express_is_not_written(name):
    with pytest.raises(ValueError, match="cannot be a name"):
        write_line(Point("m", {name: 1.0}))
