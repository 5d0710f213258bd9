# SPDX-License-Identifier: Apache-2.0
"""What is answered to mistakes: each case of the tables in `test/refusals`.

A table has `cases`, and `files` that all of them find. A case has words that say what is
shown (`case`), and one of

- `run`: what is typed behind `blf_dsc`; {bag} is a made-up bag, {folder} the folder;
- `config`: a preset or file to load, with nested parameters of the controller (`given`)
  and of the simulated arm (`plant`);
- `call`: Python that raises an error of the package, with `blf`, `np`, and `arm`, the
  `blf.Drive` of a simulated Panda, which keeps its reference.

`files` are written into an empty folder, in which all is run: their text by name; nothing
for a name with a slash at its end, which is a folder; the number of `rows` of a table
and each of its columns, as Python of the row number k; or a `copy` of one of the presets'
files, in which `new` stands for each match of `old`. `says` is what must be in what is
said, a text or a list of texts, however the lines are broken. `exit` is the code of the
command, 1 unless given; with code 1 or 2 no file is written or changed.  A case of a
parameter file with `ros` is one that ROS rejects, too (`test_configuration_files.py`).
`pytest test/test_refusals.py --regenerate-refusals` replaces each `says` that no longer
holds by the lines said now.
"""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import recorded_run
import yaml

import blf_dsc_controller as blf
from blf_dsc_controller.cli.main import main

TABLES = {
    path: yaml.safe_load(path.read_text())
    for path in sorted(Path(__file__).with_name('refusals').glob('*.yaml'))
}
CASES = [
    pytest.param(table, case, id=f'{path.stem}-{case["case"]}')
    for path, table in TABLES.items()
    for case in table['cases']
]
pytestmark = pytest.mark.usefixtures('blank_pictures')


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    path = tmp_path_factory.mktemp('made') / 'bag'
    return recorded_run.write_made(path, recorded_run.Synthetic(100).messages())


@pytest.fixture(scope='module')
def arm():
    with blf.Drive('panda', robot='simulated') as arm:
        yield arm


@pytest.fixture(scope='module', autouse=True)
def changed():
    """Hold the tables to write again, with what was said."""
    changed = []
    yield changed
    yaml.add_representer(str, represent_text)
    for path in [path for path, table in TABLES.items() if table in changed]:
        license_line = path.read_text().partition('\n')[0]
        text = yaml.dump(TABLES[path], sort_keys=False, width=88, allow_unicode=True)
        path.write_text(f'{license_line}\n{text}')


def represent_text(dumper, text):
    style = '|' if '\n' in text else None
    return dumper.represent_scalar('tag:yaml.org,2002:str', text, style=style)


def write(path, content):
    path.parent.mkdir(parents=True, exist_ok=True)
    if content is None:
        path.mkdir()
    elif isinstance(content, str):
        path.write_text(content)
    elif 'copy' in content:
        text = (blf.share_folder() / 'config' / content['copy']).read_text()
        path.write_text(re.sub(content.get('old', '$^'), content.get('new', ''), text))
    else:
        k = np.arange(content.pop('rows'))
        columns = [eval(each, {'np': np, 'k': k}) + 0 * k for each in content.values()]  # noqa: S307
        names = ','.join(content)
        np.savetxt(path, np.transpose(columns), '%.9g', ',', header=names, comments='')


def dotted(parameters, prefix=''):
    """Yield nested parameters by their dotted names."""
    for name, value in parameters.items():
        if isinstance(value, dict):
            yield from dotted(value, f'{prefix}{name}.')
        else:
            yield prefix + name, value


def files_in(folder):
    """Return when each file was changed, without what Python keeps of its own."""
    paths = [each for each in folder.rglob('*') if '__pycache__' not in each.parts]
    return {path: path.stat().st_mtime_ns for path in paths}


def answered(case, arm, capfd):
    """Return the exit code, and all that is said."""
    try:
        if 'run' in case:
            code = main(shlex.split(case['run']))
        elif 'config' in case:
            nodes = {'blf_dsc_controller': 'given', 'sim_plant': 'plant'}
            given = {k: dict(dotted(case.get(nodes[k], {}))) for k in nodes}
            code = blf.load_loop(case['config'], given) and 0
        else:
            code = exec(case['call'], {'blf': blf, 'np': np, 'arm': arm})  # noqa: S102
    except SystemExit as ended:
        code = ended.code
    except blf.BlfDscError as error:
        return 1, str(error)
    return code, ''.join(reversed(capfd.readouterr()))


@pytest.mark.parametrize(('table', 'case'), CASES)
def test_mistake_is_answered_with_what_to_do(
    table, case, changed, request, tmp_path, monkeypatch, capfd
):
    monkeypatch.chdir(tmp_path)
    for name, content in {**table.get('files', {}), **case.get('files', {})}.items():
        write(tmp_path / name, content.copy() if isinstance(content, dict) else content)
    before = files_in(tmp_path)
    run = case.get('run', '').replace('{folder}', str(tmp_path))
    if '{bag}' in run:
        run = run.replace('{bag}', str(request.getfixturevalue('bag')))
    arm = reference = None
    if 'arm.' in case.get('call', ''):
        arm = request.getfixturevalue('arm')
        reference = arm.state.reference
    code, said = answered({**case, 'run': run} if run else case, arm, capfd)
    assert code == case.get('exit', 1), said
    if arm is not None:
        np.testing.assert_array_equal(arm.state.reference, reference)
    if code in (1, 2):
        assert files_in(tmp_path) == before
    said = said.replace(str(tmp_path), '{folder}')
    assert 'Traceback' not in said
    assert 'Errno' not in said
    expected = case['says'] if isinstance(case['says'], list) else [case['says']]
    if all(' '.join(each.split()) in ' '.join(said.split()) for each in expected):
        return
    assert request.config.option.regenerate_refusals, f'{expected} is not in:\n{said}'
    case['says'] = said.strip().splitlines()
    changed.append(table)
