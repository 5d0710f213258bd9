# SPDX-License-Identifier: Apache-2.0
"""Estimates are compared with the plant's parameters by name only."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import synthetic_bag
from monte_carlo_case import LOOP, STUDY, study
from paper_case import configured
from synthetic_bag import Synthetic

from blf_dsc_controller.analysis.figures import draw
from blf_dsc_controller.analysis.summary import format_table, summarize
from blf_dsc_controller.bags.reader import read_run
from blf_dsc_controller.cli.run import LoopProgress
from blf_dsc_controller.configuration.nodes import LoopConfig
from blf_dsc_controller.simulation.bag import write_bag
from blf_dsc_controller.simulation.loop import simulate
from blf_dsc_controller.studies.runs import run_chunk

CHAIN = {'model': 'planar_chain', 'learning.initial_estimate': [0.5, 0.2, 0.16]}


def loop(**changes) -> LoopConfig:
    return configured('recommended', 10.0, CHAIN | changes)


@pytest.fixture(scope='module')
def record():
    config = loop()
    return simulate(config.controller, config.plant)


@pytest.mark.parametrize('source', ['simulation', 'bag'])
def test_planar_chain_of_two_links_has_the_error_of_the_two_link_arm(record, source, tmp_path):
    run = record.run()
    if source == 'bag':
        write_bag(tmp_path / 'bag', record, record.config, 'none')
        run = read_run(tmp_path / 'bag')
    learning = summarize(run)['learning']
    config = configured('recommended', 10.0)
    same = summarize(simulate(config.controller, config.plant).run())['learning']
    assert learning['final_relative_error'] < 1e-3
    assert learning['final_relative_error'] == pytest.approx(same['final_relative_error'], rel=1e-3)
    assert learning['true'] == same['true']


def test_progress_compares_parameters_by_name(record, capsys):
    config = loop()
    names = ('(m1+m2)*l1^2', 'm2*l1*l2', 'm2*l2^2')
    for shown, line in (
        (names, 'parameter error 0.0'),
        (('mass', 'length', 'other'), 'bound 0.50\n'),
    ):
        progress = LoopProgress(config.plant, shown)
        progress.show(10.0, 0.5, record.sample(-1).estimate[:3])
        progress.close()
        assert line in capsys.readouterr().err


def test_study_compares_parameters_by_name(tmp_path):
    same = study(tmp_path, LOOP + STUDY)
    chain = loop().controller
    learning = replace(same.controller.learning, initial_estimate=chain.learning.initial_estimate)
    other = replace(same, controller=replace(same.controller, model=chain.model, learning=learning))
    errors = [run_chunk(case, 0, 4)['parameter_error.end'] for case in (same, other)]
    np.testing.assert_allclose(errors[1], errors[0], rtol=1e-3)


def test_unknown_parameter_names_give_a_reason_instead_of_an_error(tmp_path):
    messages = Synthetic(200).messages()
    run = read_run(synthetic_bag.write(tmp_path / 'bag', messages))
    names = ('mass 1', 'mass 2', *run.learning.names[2:])
    run = replace(run, learning=replace(run.learning, names=names))
    learning = summarize(run)['learning']
    assert learning['final_relative_error'] is None
    assert learning['true'] is None
    assert list(learning['final_estimate']) == ['mass 1', 'mass 2', 'm2*l1*l2']
    table = format_table(summarize(run))
    assert 'parameters  not comparable: the model has mass 1, mass 2, m2*l1*l2, the plant ' in table
    assert 'the plant (m1+m2)*l1^2, m2*l2^2, m2*l1*l2' in table
    draw(run, tmp_path)
