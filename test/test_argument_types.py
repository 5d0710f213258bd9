# SPDX-License-Identifier: Apache-2.0
"""Arguments of public functions that are swapped or of another type: what is said of them."""

from __future__ import annotations

import pytest

import blf_dsc_controller as blf
from blf_dsc_controller.errors import BlfDscError, check_type

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


def test_argument_of_one_of_several_types_is_accepted():
    check_type('size', 1.0, (int, float), 'none')
    with pytest.raises(
        TypeError, match=r'^size: got str, expected int or float: a number'
    ):
        check_type('size', '1', (int, float), 'a number')
