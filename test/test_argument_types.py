# SPDX-License-Identifier: Apache-2.0
"""Arguments of public functions that are swapped or of another type: what is said of them."""

from __future__ import annotations

import pytest

import blf_dsc_controller as blf
from blf_dsc_controller import BlfDscError
from blf_dsc_controller.errors import check_type

LOOP = blf.load_loop('paper')


@pytest.mark.parametrize(
    ('call', 'named'),
    [
        (
            lambda: blf.simulate(LOOP.plant, LOOP.controller),
            ('controller_config: got PlantConfig', 'ControllerConfig', 'load_loop'),
        ),
        (
            lambda: blf.simulate(LOOP.controller, LOOP.controller),
            ('plant_config: got ControllerConfig', 'PlantConfig', 'load_loop'),
        ),
        (
            lambda: blf.controller_of(LOOP),
            ('config: got LoopConfig', 'ControllerConfig', '.controller'),
        ),
        (
            lambda: blf.measure(LOOP.controller),
            ('run: got ControllerConfig', 'Run', 'read_run'),
        ),
        (
            lambda: blf.draw(LOOP.controller, 'never_created'),
            ('run: got ControllerConfig', 'Run', 'read_run'),
        ),
        (
            lambda: blf.change(LOOP, {'duration': 1.0}),
            ('config: got LoopConfig', 'ControllerConfig', '.plant'),
        ),
        (
            lambda: blf.ArmController(LOOP.plant),
            ('config: got PlantConfig', 'ControllerConfig or str or Path'),
        ),
        (
            lambda: blf.load_loop(5),
            ('config: got int', 'str or Path', 'name of a preset'),
        ),
        (
            lambda: blf.load_study(None),
            ('config: got NoneType', 'str or Path', 'name of a preset'),
        ),
        (
            lambda: blf.Commissioning(LOOP),
            ('config: got LoopConfig', 'str or Path', 'name of a preset'),
        ),
        (
            lambda: blf.load_loop('paper', 10.0),
            ('overrides: got float', 'Mapping', "{'sim_plant': {'duration'"),
        ),
        (
            lambda: blf.change(LOOP.controller, None),
            ('given: got NoneType', 'Mapping', 'by name'),
        ),
        (lambda: blf.read_run(None), ('path: got NoneType', 'folder of a bag')),
        (lambda: blf.verify(5), ('path: got int', 'folder of a bag')),
    ],
)
def test_wrong_argument_is_a_type_error_that_names_it_and_the_remedy(
    call, named, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(TypeError) as caught:
        call()
    assert isinstance(caught.value, BlfDscError)
    for each in named:
        assert each in str(caught.value)
    assert not any(tmp_path.iterdir())


def test_trajectory_that_is_no_sequence_is_a_type_error_that_names_it():
    with (
        blf.ArmController(LOOP.controller) as controller,
        pytest.raises(blf.ArgumentTypeError, match=r'points: got NoneType.*a list of'),
    ):
        controller.follow(None)


def test_argument_of_one_of_several_types_is_accepted():
    check_type('size', 1.0, (int, float), 'none')
    with pytest.raises(
        TypeError, match=r'^size: got str, expected int or float: a number'
    ):
        check_type('size', '1', (int, float), 'a number')
