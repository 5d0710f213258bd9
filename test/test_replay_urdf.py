# SPDX-License-Identifier: Apache-2.0
"""Bags hold the text of the URDF: they replay after its file was deleted or changed."""

from __future__ import annotations

import pytest
from random_arm import random_urdf

from blf_dsc_controller.bags.content import read_content
from blf_dsc_controller.bags.reader import read_run
from blf_dsc_controller.configuration.nodes import dump, load_loop
from blf_dsc_controller.replay.verify import verify
from blf_dsc_controller.simulation.bag import write_bag
from blf_dsc_controller.simulation.loop import simulate

PARAMETERS = """
/**:
  ros__parameters:
    robot: {{urdf: {urdf}, tip: tip}}
/sim_plant:
  ros__parameters: {{duration: 0.2, truth.mass_deviation: 0.3}}
"""


@pytest.fixture
def recorded(tmp_path):
    """URDF, configurations and bag of a run with three joints."""
    urdf, file = tmp_path / 'arm.urdf', tmp_path / 'arm.yaml'
    urdf.write_text(random_urdf(3, seed=5)[0])
    file.write_text(PARAMETERS.format(urdf=urdf))
    loop = load_loop(file)
    record = simulate(loop.controller, loop.plant)
    write_bag(tmp_path / 'bag', record, loop.controller, 'none', loop.plant)
    return urdf, loop, tmp_path / 'bag'


def test_bag_replays_bit_for_bit_without_its_urdf_file(recorded):
    urdf, _, bag = recorded
    urdf.unlink()
    verified = verify(bag)
    assert verified.difference is None
    assert verified.transitions == ['activate']
    assert read_run(bag).arm is not None


def test_changing_the_urdf_file_does_not_affect_the_bag(recorded):
    urdf, loop, bag = recorded
    urdf.write_text(random_urdf(3, seed=6)[0])
    assert read_content(bag).controller_config() == loop.controller
    assert verify(bag).difference is None


def test_dumped_configuration_needs_no_other_file(recorded, tmp_path):
    urdf, loop, _ = recorded
    dump(tmp_path / 'config.yaml', loop.by_node)
    urdf.unlink()
    assert load_loop(tmp_path / 'config.yaml') == loop
