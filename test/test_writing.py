# SPDX-License-Identifier: Apache-2.0
"""Files that cannot be written are named, and nothing of them is left."""

from __future__ import annotations

import pytest
from recorded_run import limited_files

from blf_dsc_controller import BlfDscError
from blf_dsc_controller.writing import write_text, writing


@pytest.fixture
def full(tmp_path):
    """A folder in which files end at 1,000 bytes."""
    with limited_files(tmp_path / 'disk', size=1000) as disk:
        yield disk


def test_text_that_the_disk_does_not_hold_leaves_no_stump(full):
    path = full / 'page.html'
    with pytest.raises(
        BlfDscError, match=r'page\.html cannot be written: File too large'
    ):
        write_text(path, 'x' * 5000)
    assert not path.exists()
    write_text(path, 'x' * 500)
    assert path.read_text() == 'x' * 500


def test_folder_that_the_disk_does_not_hold_leaves_nothing(full):
    def fill(folder):
        folder.mkdir()
        (folder / 'small').write_text('x')
        (folder / 'large').write_text('x' * 5000)

    with (
        pytest.raises(BlfDscError, match='nothing of it is left'),
        writing(full / 'bag') as part,
    ):
        fill(part)
    assert not list(full.iterdir())


def test_what_was_there_stays_until_the_new_one_is_whole(tmp_path):
    path = tmp_path / 'page.html'
    path.write_text('old')

    def interrupted():
        with writing(path) as part:
            part.write_text('ne')
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert [each.read_text() for each in tmp_path.iterdir()] == ['old']
    with writing(path) as part:
        part.write_text('new')
        assert path.read_text() == 'old'
    assert [each.read_text() for each in tmp_path.iterdir()] == ['new']


def test_device_is_written_itself_and_not_replaced(tmp_path):
    link = tmp_path / 'nowhere'
    link.symlink_to('/dev/null')
    write_text(link, 'x')
    assert link.is_symlink()
    assert not link.is_file()
