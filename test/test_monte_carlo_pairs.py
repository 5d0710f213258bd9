# SPDX-License-Identifier: Apache-2.0
"""Learning does no harm to arms that change from the start: some runs of `make changes`.

Each case has a run that the paper's form of the law, in which what is learned acts through the
feedback, takes out of a bound that is kept without learning.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from blf_dsc_controller.configuration.nodes import locate
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.studies.monte_carlo import load_study
from blf_dsc_controller.studies.runs import run_chunk
from blf_dsc_controller.studies.statistics import compare

FIRST = {'monte_carlo_events': 16, 'monte_carlo_panda': 6, 'monte_carlo_ur5e': 6}


def pairs(name, **law):
    """Return the comparison of the first runs of a study, with changes to the law."""
    study = load_study(locate(name))
    given = {f'learning.{parameter}': value for parameter, value in law.items()}
    study = replace(study, controller=change(study.controller, given))
    return compare(study, run_chunk(study, 0, FIRST[name]))


@pytest.mark.parametrize('name', FIRST)
def test_learning_breaks_no_bound_and_finds_the_model(name):
    found = pairs(name)
    assert found['kept']['without'] >= FIRST[name] // 3
    assert found['broken_only_with'] == []
    assert found['above'] == []
    torque = found['median']['torque_error']
    assert torque['with'] < torque['without']


@pytest.mark.parametrize('name', FIRST)
def test_papers_form_breaks_bounds_that_are_kept_without_learning(name):
    with np.errstate(all='ignore'):  # some of these runs diverge
        assert pairs(name, compensation='state')['broken_only_with'] != []
