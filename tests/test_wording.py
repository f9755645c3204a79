"""Format of percentages and positions in messages."""

import ast

import numpy as np
import pytest

from fenics_contact.wording import format_point, percent


@pytest.mark.parametrize("unit", [1e-9, 1e-6, 1.0, 1e6])
def test_position_has_six_digits_in_any_unit(unit):
    """The printed numbers differ by at most half of the sixth digit of the largest one."""
    place = unit * np.array([1.2345678, -0.4567891, 1e-12])
    coordinates = np.array(ast.literal_eval(format_point(place)))
    assert np.abs(coordinates - place).max() <= 0.5e-5 * unit
    assert coordinates[2] == 0.0 and np.all(coordinates[:2] != 0.0)


def test_position_at_the_origin_or_not_finite():
    """The origin and a NaN are printed as such."""
    assert format_point([0.0, 0.0]) == "[0.0, 0.0]"
    assert format_point([np.nan, 1.0]) == "[nan, 1.0]"


@pytest.mark.parametrize(
    ("ratio", "text"),
    [(0.0, "0 %"), (1.234e-4, "0.012 %"), (0.7581, "76 %"), (0.996, "100 %"), (12.34, "1234 %")],
)
def test_percentages_have_no_exponent(ratio, text):
    """Fractions are printed as percentages without an exponent."""
    assert percent(ratio) == text
