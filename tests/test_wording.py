"""Shares and places as messages say them."""

import ast

import numpy as np
import pytest

from fenics_contact.wording import format_point, percent


@pytest.mark.parametrize("unit", [1e-9, 1e-6, 1.0, 1e6])
def test_a_place_has_six_digits_in_any_unit(unit):
    """The numbers that are said, read back: half of the sixth digit of the largest, at most."""
    place = unit * np.array([1.2345678, -0.4567891, 1e-12])
    said = np.array(ast.literal_eval(format_point(place)))
    assert np.abs(said - place).max() <= 0.5e-5 * unit
    assert said[2] == 0.0 and np.all(said[:2] != 0.0)


def test_a_place_without_digits():
    """The origin, and a place that is no number."""
    assert format_point([0.0, 0.0]) == "[0.0, 0.0]"
    assert format_point([np.nan, 1.0]) == "[nan, 1.0]"


@pytest.mark.parametrize(
    ("share", "said"),
    [(0.0, "0 %"), (1.234e-4, "0.012 %"), (0.7581, "76 %"), (0.996, "100 %"), (12.34, "1234 %")],
)
def test_shares_are_said_without_exponent(share, said):
    """As read in a sentence."""
    assert percent(share) == said
