"""Arguments that are one of a few words."""

import numpy as np
import pytest

from calibration.dynamics.modal_identification import identify_modes
from reporting.choices import one_of
from reporting.errors import InvalidChoiceError


def test_a_word_that_is_not_allowed_is_told_beside_the_nearest():
    with pytest.raises(
        InvalidChoiceError, match=r"`kind` must be 'ambient' or 'decay', and 'Decai' came; .*'decay'"
    ):
        one_of("Decai", ("ambient", "decay"), "kind")


@pytest.mark.parametrize("value", [None, True, 1.0, "2", ["ambient"], np.array(["ambient"])])
def test_what_only_equals_an_allowed_value_is_refused(value):
    with pytest.raises(InvalidChoiceError, match="must be"):
        one_of(value, (1, "ambient"), "version")


def test_an_unknown_kind_of_record_is_not_taken_for_a_decay():
    with pytest.raises(InvalidChoiceError, match=r"'ambient' or 'decay', and 'free decay' came"):
        identify_modes(np.zeros((2000, 1)), 100.0, [[1.0, 5.0]], "free decay")
