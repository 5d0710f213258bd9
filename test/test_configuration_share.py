# SPDX-License-Identifier: Apache-2.0
"""The presets are found where the package is installed, and nowhere else."""

import sysconfig
from pathlib import Path

import pytest

from blf_dsc_controller.configuration import share
from blf_dsc_controller.configuration.params_file import locate
from blf_dsc_controller.configuration.share import share_folder
from blf_dsc_controller.errors import BlfDscError


def installed(prefix):
    """Make a share folder as an installation below `prefix` has it."""
    folder = prefix / 'share' / 'blf_dsc_controller'
    (folder / 'config').mkdir(parents=True)
    (folder / 'config' / 'recommended.yaml').touch()
    return folder


def index(prefix):
    """Enter the package in the ament index of `prefix`."""
    packages = prefix / 'share' / 'ament_index' / 'resource_index' / 'packages'
    packages.mkdir(parents=True)
    (packages / 'blf_dsc_controller').touch()


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    """Run from no source tree, with no ROS and nothing installed, in a misleading folder."""
    here = tmp_path / 'here'
    installed(here)
    (here / 'config').mkdir()
    (here / 'config' / 'recommended.yaml').touch()
    (here / 'recommended.yaml').touch()
    monkeypatch.chdir(here)
    monkeypatch.setattr(share, '_CHECKOUT', tmp_path / 'no_checkout')
    monkeypatch.delenv('AMENT_PREFIX_PATH', raising=False)
    monkeypatch.setattr(
        sysconfig, 'get_path', lambda _name, scheme: str(tmp_path / f'python_{scheme}')
    )


def data_folder(tmp_path, scheme):
    return tmp_path / f'python_{scheme}'


def test_ament_index_knows_it(tmp_path, monkeypatch):
    pytest.importorskip('ament_index_python', reason='no ROS here')
    index(tmp_path / 'workspace')
    folder = installed(tmp_path / 'workspace')
    installed(data_folder(tmp_path, sysconfig.get_default_scheme()))
    monkeypatch.setenv('AMENT_PREFIX_PATH', str(tmp_path / 'workspace'))
    assert share_folder() == folder


def test_ros_that_does_not_know_it_is_passed_over(tmp_path, monkeypatch):
    (tmp_path / 'opt').mkdir()
    monkeypatch.setenv('AMENT_PREFIX_PATH', str(tmp_path / 'opt'))
    folder = installed(data_folder(tmp_path, sysconfig.get_default_scheme()))
    assert share_folder() == folder


@pytest.mark.parametrize(
    'scheme', [sysconfig.get_default_scheme(), sysconfig.get_preferred_scheme('user')]
)
def test_pip_installs_it_for_all_or_for_the_user(tmp_path, scheme):
    folder = installed(data_folder(tmp_path, scheme))
    assert share_folder() == folder


def test_source_tree_counts_before_an_installation(tmp_path, monkeypatch):
    installed(data_folder(tmp_path, sysconfig.get_default_scheme()))
    checkout = tmp_path / 'checkout'
    (checkout / 'config').mkdir(parents=True)
    (checkout / 'setup.py').touch()
    monkeypatch.setattr(share, '_CHECKOUT', checkout)
    assert share_folder() == checkout


def test_current_folder_never_counts():
    with pytest.raises(BlfDscError, match='install the package again') as error:
        share_folder()
    assert str(Path.cwd()) not in str(error.value)


@pytest.mark.parametrize('name', ['recommended', './recommended.yaml'])
def test_the_name_of_a_preset_means_the_installed_one(tmp_path, name):
    folder = installed(data_folder(tmp_path, sysconfig.get_default_scheme()))
    found = locate(name)
    assert (found == folder / 'config' / 'recommended.yaml') == (name == 'recommended')


def test_unknown_preset_lists_the_presets(tmp_path):
    folder = installed(data_folder(tmp_path, sysconfig.get_default_scheme()))
    (folder / 'config' / 'paper.yaml').touch()
    with pytest.raises(BlfDscError, match=r'papre does not exist: .* preset: paper, recommended'):
        locate('papre')
