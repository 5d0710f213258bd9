# SPDX-License-Identifier: Apache-2.0
"""Choice of the model by cross-validation, on problems whose folds are known."""

from __future__ import annotations

import numpy as np
import pytest

from blf_dsc_controller.identification.prior import Prior
from blf_dsc_controller.identification.regression import Regression
from blf_dsc_controller.identification.selection import prior_widths

BODY = 0  # index of the first value of a body


def prior_of_one_joint():
    """A prior in which nothing but one value of the body is not known."""
    size = 17 + 14
    D = np.zeros((size, size))
    D[BODY, BODY] = 1.0
    return Prior(np.zeros(size), D, [], np.zeros(size))


def folds_that_show(values, weight=0.2):
    """Folds of one joint: each alone would find its value, with this squared weight."""
    size = 17 + 14 + 1
    folds = np.zeros((len(values), 1, size, size))
    for k, value in enumerate(values):
        row = np.zeros(size)
        row[BODY], row[-1] = 1.0, value
        folds[k, 0] = weight * np.outer(row, row)
    nothing = np.zeros(0)
    return Regression(
        nothing, nothing, folds, nothing, nothing, nothing, delay=0.0, rows=None
    )


@pytest.mark.parametrize(
    ('values', 'width'),
    [
        # ten deviations of the prior, which all parts agree on
        ([10.0, 10.0, 10.0, 10.0], 30.0),
        # better in sum, but worse where it is not so: a disturbance of three parts
        ([10.0, 10.0, 10.0, 0.0], 1.0),
        ([0.5, 0.5, 0.5, 0.5], 30.0),
        ([0.0, 0.0, 0.0, 0.0], 1.0),
    ],
)
def test_prior_is_widened_only_if_that_predicts_every_part_better(values, width):
    widths = prior_widths(folds_that_show(values), prior_of_one_joint())
    assert widths['bodies'] == width
    others = [found for group, found in widths.items() if group != 'bodies']
    assert set(others) == {1.0}
