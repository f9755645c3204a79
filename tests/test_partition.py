"""Sums and norms by body, against direct evaluation over masks."""

import numpy as np
import pytest
from mpi4py import MPI

from fenics_contact.systems.partition import Partition, norms_by_part

N_PARTS = 4


def make(order: str) -> tuple[np.ndarray, Partition]:
    """Return labels of 300 entries, of which part 2 has none, and their partition."""
    label = np.random.default_rng(1).choice([-1, 0, 1, 3], 300)
    label = {"scattered": label, "contiguous": np.sort(label), "single": 0 * label}[order]
    return label, Partition(label, N_PARTS)


@pytest.mark.parametrize("order", ["scattered", "contiguous", "single"])
def test_sums_by_part(order):
    """Sums, products, norms and largest values, to round-off of 300 terms; -1 is no part."""
    label, partition = make(order)
    one, other = np.random.default_rng(2).normal(size=(2, label.size))
    masks = [label == part for part in range(N_PARTS)]
    near = {"rtol": 1e-13, "atol": 1e-13}
    assert np.array_equal(partition.sizes, [mask.sum() for mask in masks])
    absolute = [np.abs(one[m]).sum() for m in masks]
    assert np.allclose(partition.absolute_sums(one), absolute, **near)
    assert np.allclose(partition.products(one, other), [one[m] @ other[m] for m in masks], **near)
    assert np.allclose(partition.norms(one), [np.linalg.norm(one[m]) for m in masks], **near)
    assert np.array_equal(partition.largest(one), [np.abs(one[m]).max(initial=0.0) for m in masks])
    factors = np.arange(1.0, N_PARTS + 1)
    of_part = label >= 0
    assert np.array_equal(partition.scale(one, factors)[of_part], (one * factors[label])[of_part])


def test_norms_of_huge_and_tiny_vectors():
    """No overflow or underflow at 1e±250; a vector that is not finite has no norms at all."""
    label, partition = make("scattered")
    values = np.random.default_rng(3).normal(size=label.size)
    expected = norms_by_part(MPI.COMM_SELF, N_PARTS, [(values, partition)])[0]
    not_finite = values.copy()
    not_finite[0] = np.nan
    rows = [(1e250 * values, partition), (1e-250 * values, partition), (not_finite, partition)]
    huge, tiny, undefined = norms_by_part(MPI.COMM_SELF, N_PARTS, rows)
    assert np.allclose(huge / 1e250, expected, rtol=1e-12)
    assert np.allclose(tiny / 1e-250, expected, rtol=1e-12)
    assert np.isnan(undefined).all()
