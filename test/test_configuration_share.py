# SPDX-License-Identifier: Apache-2.0
"""Presets are found where the package is installed, and nowhere else."""

import sysconfig
from pathlib import Path

import pytest

from blf_dsc_controller.configuration import files as share
from blf_dsc_controller.configuration.files import share_folder
from blf_dsc_controller.errors import BlfDscError


def installed(prefix):
    """Create the share folder of an installation below `prefix`."""
    folder = prefix / 'share' / 'blf_dsc_controller'
    (folder / 'config').mkdir(parents=True)
    (folder / 'config' / 'recommended.yaml').touch()
    return folder


def index(prefix):
    """Add the package to the ament index of `prefix`."""
    packages = prefix / 'share' / 'ament_index' / 'resource_index' / 'packages'
    packages.mkdir(parents=True)
    (packages / 'blf_dsc_controller').touch()


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    """Run outside a source tree, without ROS or an installation, in a misleading folder."""
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


def test_package_is_found_through_the_ament_index(tmp_path, monkeypatch):
    pytest.importorskip('ament_index_python', reason='no ROS here')
    index(tmp_path / 'workspace')
    folder = installed(tmp_path / 'workspace')
    installed(data_folder(tmp_path, sysconfig.get_default_scheme()))
    monkeypatch.setenv('AMENT_PREFIX_PATH', str(tmp_path / 'workspace'))
    assert share_folder() == folder


def test_ros_without_the_package_is_skipped(tmp_path, monkeypatch):
    (tmp_path / 'opt').mkdir()
    monkeypatch.setenv('AMENT_PREFIX_PATH', str(tmp_path / 'opt'))
    folder = installed(data_folder(tmp_path, sysconfig.get_default_scheme()))
    assert share_folder() == folder


@pytest.mark.parametrize(
    'scheme', [sysconfig.get_default_scheme(), sysconfig.get_preferred_scheme('user')]
)
def test_system_and_user_installations_by_pip_are_found(tmp_path, scheme):
    folder = installed(data_folder(tmp_path, scheme))
    assert share_folder() == folder


def test_source_tree_takes_precedence_over_an_installation(tmp_path, monkeypatch):
    installed(data_folder(tmp_path, sysconfig.get_default_scheme()))
    checkout = tmp_path / 'checkout'
    (checkout / 'config').mkdir(parents=True)
    (checkout / 'setup.py').touch()
    monkeypatch.setattr(share, '_CHECKOUT', checkout)
    assert share_folder() == checkout


def test_current_folder_is_never_used():
    with pytest.raises(BlfDscError, match='install the package again') as error:
        share_folder()
    assert str(Path.cwd()) not in str(error.value)
