# SPDX-License-Identifier: Apache-2.0
"""MJCF that asks for more than a computer has."""

from __future__ import annotations

import re

import pytest

from blf_dsc_controller.cli.main import main
from blf_dsc_controller.configuration import mjcf
from blf_dsc_controller.errors import BlfDscError

REPLICAS = (
    '<replicate count="1000">' * 3
    + '<body><geom size="1" /></body>'
    + '</replicate>' * 3
)


@pytest.mark.parametrize(
    ('part', 'message'),
    [
        (
            '<asset><hfield name="h" nrow="60000" ncol="60000" size="1 1 1 1" /></asset>',
            '3600000000 cells',
        ),
        (
            f'<worldbody>{REPLICAS}</worldbody>',
            'with what it replicates',
        ),
        ('<custom><numeric name="n" size="2000000000" /></custom>', 'cells'),
        ('<size nuser_body="2000000000" />', 'cells'),
    ],
)
def test_mjcf_that_asks_for_gigabytes_is_refused_before_it_is_compiled(
    part, message, tmp_path, capsys
):
    text = f'<mujoco>{part}</mujoco>'
    with pytest.raises(BlfDscError, match=message):
        mjcf.urdf_of_text(text)
    (tmp_path / 'part.xml').write_text(text)
    whole = tmp_path / 'whole.xml'
    whole.write_text('<mujoco><include file="part.xml" /></mujoco>')
    command = ['identify', 'run.csv', '--urdf', str(whole), '--foresee']
    assert main(command) == 1
    error = capsys.readouterr().err
    assert re.search(message, error)
    assert error.count('\n') == 1
