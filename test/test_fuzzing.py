# SPDX-License-Identifier: Apache-2.0
"""Random external input: names, bags in all their parts, parameter files, URDFs.

And a soak.

Each property states that a command ends with its result or an error of the package: no
other exception, no hang, bounded memory, nothing opened outside of the folder, nothing
imported. `make fuzz EXAMPLES=1000` looks for counterexamples, the nightly tests try a
few; `make soak` runs soak.py for half an hour, here it runs for seconds.
"""

from __future__ import annotations

import contextlib
import functools
import io
import json
import os
import resource
import signal
import struct
import subprocess
import sys
import tempfile
import warnings
from dataclasses import fields
from pathlib import Path
from xml.etree import ElementTree as ET
from zlib import crc32

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from mcap import records
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Chunk, Message

pytest.importorskip('rclpy', reason='needs ROS 2')
pytest.importorskip('plotly', reason='needs plotly: pip install .[report]')

import recorded_run
from recorded_run import raw_records

import blf_dsc_controller as blf
from blf_dsc_controller.bags.sources import open_bag
from blf_dsc_controller.bags.unpacking import unpacked
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.messages.codecs import typestore
from blf_dsc_controller.messages.topics import JOURNAL

MOST_SECONDS = 60.0  # of CPU time
MOST_MEMORY = 600_000_000  # bytes on top of what the process had before
MOST_ADDRESSES = 3 << 30  # bytes, likewise: where an allocation fails
ASIDE = 'elsewhere'

pytestmark = pytest.mark.nightly

fuzzed = settings(
    max_examples=int(os.environ.get('EXAMPLES', '8')),
    deadline=None,
    phases=(Phase.reuse, Phase.generate),
    suppress_health_check=list(HealthCheck),
)
# The suite removes its folder of logs at the end; a folder of our own goes with the
# process.
_made = tempfile.TemporaryDirectory(
    prefix='fuzzing_', dir=os.environ.get('ROS_LOG_DIR')
)
_folder = Path(_made.name)
_opened: list[str] = []


def _watch(event, arguments):
    if event == 'open' and ASIDE in str(arguments[0]):
        _opened.append(str(arguments[0]))


@functools.cache
def watch():
    """Note from now on which files are opened: no other test of this process is to pay for it."""
    sys.addaudithook(_watch)


class HangError(BaseException):
    """A command took too long."""


def _hang(*_):
    raise HangError


def status_of(name):
    """Return a size of this process [bytes]."""
    text = Path('/proc/self/status').read_text()
    return int(text.partition(f'{name}:')[2].split()[0]) * 1024


@contextlib.contextmanager
def bounded():
    """Run the tested code within limits."""
    watch()
    before = set(sys.modules)
    _opened.clear()
    limits = resource.getrlimit(resource.RLIMIT_AS)
    handler = signal.signal(signal.SIGPROF, _hang)
    Path('/proc/self/clear_refs').write_text('5')  # the peak begins anew
    memory = status_of('VmRSS')
    most = status_of('VmSize') + MOST_ADDRESSES
    resource.setrlimit(resource.RLIMIT_AS, (most, limits[1]))
    signal.setitimer(signal.ITIMER_PROF, MOST_SECONDS)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter('ignore', RuntimeWarning)  # from infinite numbers
            yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        resource.setrlimit(resource.RLIMIT_AS, limits)
        signal.signal(signal.SIGPROF, handler)
    assert not _opened, _opened
    assert status_of('VmHWM') < memory + MOST_MEMORY
    odd = {
        module
        for module in set(sys.modules) - before
        if module.split('.')[0] in ODD_MODULES
    }
    assert not odd, odd


def command(*words):
    """Run a command and return its exit code.

    Its output must not contain a traceback.
    """
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        code = main([str(word) for word in words])
    assert 'Traceback' not in said.getvalue()
    assert code in (0, 1, 3, 4, 5), said.getvalue()
    return code


# Names.

ODD_MODULES = ('unittest', 'this', 'antigravity', 'idlelib', 'turtle', 'test')
PARTS = st.one_of(
    st.sampled_from(
        ('std_msgs', 'msg', 'srv', 'String', '__main__', *ODD_MODULES, '..', '')
    ),
    st.text(max_size=8),
)


@fuzzed
@given(name=st.one_of(st.lists(PARTS, max_size=5).map('/'.join), st.text(max_size=30)))
def test_names_are_survived(name):
    """Names of types, topics and joints."""
    from blf_dsc_controller.bags.content import NameMap
    from blf_dsc_controller.messages.codecs import UnknownTypeError
    from blf_dsc_controller.nodes.endpoints import message_class, register_definition

    with bounded():
        with contextlib.suppress(ImportError, AttributeError):
            assert message_class(name).__module__.split('.')[0] == name.split('/')[0]
        with contextlib.suppress(UnknownTypeError):
            register_definition(name)
        with contextlib.suppress(blf.BlfDscError):
            NameMap.parse([name, f'joint1={name}'])


# Bags.


@functools.cache
def base():
    """Return the bag of a short run, from which all others are derived."""
    return recorded_run.record(_folder / 'base', 0.1)


@functools.cache
def secret():
    """Create a file that no bag may lead to; return its folder."""
    folder = _folder / ASIDE
    folder.mkdir()
    (folder / 'secret.mcap').write_bytes((base() / 'base_0.mcap').read_bytes())
    return folder


READ = ('export', 'replay', 'recover', 'part', 'identify')
DRAW = ('report', 'pictures')
WAYS = st.sampled_from((*READ * 5, *DRAW))


def read(bag, way):
    """Read a bag in one of several ways."""
    out = bag.parent / 'out'
    if way == 'part':
        with contextlib.suppress(blf.BlfDscError), open_bag(bag) as opened:
            list(opened.messages(opened.counts))
    elif way == 'replay':
        command('replay', bag)
    elif way == 'report':
        command('report', bag, '--out', out / 'page.html')
    elif way == 'pictures':
        command('report', bag, '--png', out)
    elif way == 'identify':
        urdf = blf.share_folder() / 'config' / 'two_link.urdf'
        command('identify', bag, '--urdf', urdf, '--out', bag.parent / 'out.urdf')
    elif way == 'export':
        command('export', bag, '--out', bag.parent / 'out.csv')
    else:
        command(way, bag, '--out', out)


@contextlib.contextmanager
def folder():
    """Provide a folder for one example, beside the secret one."""
    secret()
    with tempfile.TemporaryDirectory(dir=_folder) as made:
        (Path(made) / 'bag').mkdir()
        yield Path(made) / 'bag'


WORDS = st.one_of(
    st.sampled_from(
        ('nan', '.inf', '-1', '1e308', '0', '[]', '[[1.0]]', '{}', 'null', '""', '*a')
    ),
    st.sampled_from(
        ('&a [1]', '!!binary x', '[' * 200, '0x', '"\\0"', '2.0e-320', '1e999', '~')
    ),
    st.sampled_from(
        ('mcap', 'sqlite3', 'zstd', 'file', 'message', f'../../{ASIDE}/secret.mcap')
    ),
    st.integers().map(str),
    st.floats().map(str),
    st.lists(st.floats(), max_size=4).map(str),
    st.text(max_size=12),
    st.text('[]{}&*!|>-:# \n\tab\0é', max_size=20),
)


def disordered(data, items, change):
    """Return the items with some changed, removed or repeated elsewhere."""
    items = list(items)
    for _ in range(data.draw(st.integers(1, 4)) if items else 0):
        at = data.draw(st.integers(0, len(items) - 1))
        action = data.draw(st.sampled_from(('change', 'change', 'remove', 'repeat')))
        if action == 'change':
            items[at] = change(items[at])
        elif action == 'repeat':
            items.insert(data.draw(st.integers(0, len(items))), items[at])
        elif len(items) > 1:
            del items[at]
    return items


def damaged(data, text):
    """Return YAML with other values; lines repeated, removed or extended."""

    def change(line):
        begin = data.draw(st.sampled_from((line, f'{line.partition(":")[0]}: ')))
        return begin + data.draw(WORDS)

    return '\n'.join(disordered(data, text.splitlines(), change)).encode(
        'utf-8', 'surrogatepass'
    )


NUMBERS = st.sampled_from((0, 1, 3, 2**31 - 1, 2**32 - 1, 0x7FF00000, 2**63, 2**64 - 1))


def corrupted(data, raw):
    """Return bytes with one changed, a number changed, some added, or the rest missing or other."""
    place = data.draw(st.integers(0, len(raw)))
    kept = data.draw(st.sampled_from((0, 1, 4, 8)))  # after what is replaced
    if kept > 1:
        place -= place % kept
    number = (data.draw(NUMBERS) % 2 ** (8 * kept)).to_bytes(kept, 'little')
    new = data.draw(st.one_of(st.just(number), st.binary(max_size=12)))
    end = raw[place + kept :] if data.draw(st.integers(0, 3)) else b''
    return raw[:place] + new + end


@fuzzed
@given(data=st.data(), way=WAYS)
def test_metadata_is_survived(data, way):
    """metadata.yaml: other values, missing entries, other text."""
    with folder() as bag:
        (bag / 'base_0.mcap').write_bytes((base() / 'base_0.mcap').read_bytes())
        text = (base() / 'metadata.yaml').read_text()
        (bag / 'metadata.yaml').write_bytes(damaged(data, text))
        with bounded():
            read(bag, way)


@fuzzed
@given(data=st.data(), way=WAYS)
def test_records_are_survived(data, way):
    """MCAP files: records changed, removed or repeated, their lengths, too.

    Files truncated.
    """

    def change(raw):
        length = data.draw(st.none() | NUMBERS | st.integers(0, 2**64 - 1))
        if length is None:
            return corrupted(data, raw)
        return raw[:1] + length.to_bytes(8, 'little') + raw[9:]

    (file,) = base().glob('*.mcap')
    found = [raw for _, raw in raw_records(file.read_bytes())]
    magic = b'\x89MCAP0\r\n'
    content = magic + b''.join(disordered(data, found, change)) + magic
    if data.draw(st.integers(0, 9)) == 0:
        content = content[: data.draw(st.integers(0, len(content)))]
    with folder() as bag:
        (bag / 'base_0.mcap').write_bytes(content)
        (bag / 'metadata.yaml').write_bytes((base() / 'metadata.yaml').read_bytes())
        with bounded():
            read(data.draw(st.sampled_from((bag, bag / 'base_0.mcap'))), way)


def rewritten(data, raw):
    """Return a record whose fields have other values, within their widths; a chunk's content."""
    opcode = Opcode(raw[0])
    if opcode == Opcode.CHUNK and data.draw(st.integers(0, 4)):
        return repacked(data, Chunk.read(ReadDataStream(io.BytesIO(raw[9:]))))
    kind = getattr(records, opcode.name.title().replace('_', ''))
    length = [len(raw) - 9] if kind is Message else []
    record = kind.read(ReadDataStream(io.BytesIO(raw[9:])), *length)
    name = data.draw(st.sampled_from([each.name for each in fields(kind)] or ['']))
    if not name:
        return raw
    value = getattr(record, name)
    others = {
        int: lambda: NUMBERS | st.integers(0, 2**16 - 1),
        str: lambda: WORDS.map(lambda text: text.encode('utf-8', 'ignore').decode()),
        bytes: lambda: st.binary(max_size=20) | st.just(value[:9]),
    }
    strategy = others.get(type(value), lambda: st.just(type(value)()))
    setattr(record, name, data.draw(strategy()))
    builder = RecordBuilder()
    try:
        record.write(builder)
    except struct.error:  # the number is too large for its field
        return raw
    return builder.end()


def repacked(data, chunk):
    """Return a chunk whose records are others, though its size and its checksum match."""
    try:
        content = unpacked(chunk.data, chunk.compression)
    except ValueError:  # changed before
        content = chunk.data
    inside = [raw for _, raw in raw_records(bytes(8) + content + bytes(8))]
    content = b''.join(disordered(data, inside, lambda raw: rewritten(data, raw)))
    builder = RecordBuilder()
    Chunk(
        '',
        content,
        chunk.message_end_time,
        chunk.message_start_time,
        crc32(content),
        len(content),
    ).write(builder)
    return builder.end()


@fuzzed
@given(data=st.data(), way=WAYS)
def test_structure_of_records_is_survived(data, way):
    """MCAP files whose records have other fields, lengths and checksums that match, or others."""
    (file,) = base().glob('*.mcap')
    found = [raw for _, raw in raw_records(file.read_bytes())]
    magic = b'\x89MCAP0\r\n'
    changed = disordered(data, found, lambda raw: rewritten(data, raw))
    with folder() as bag:
        (bag / 'base_0.mcap').write_bytes(magic + b''.join(changed) + magic)
        (bag / 'metadata.yaml').write_bytes((base() / 'metadata.yaml').read_bytes())
        with bounded():
            read(data.draw(st.sampled_from((bag, bag / 'base_0.mcap'))), way)


@fuzzed
@given(data=st.data(), way=WAYS)
def test_messages_are_survived(data, way):
    """Serialised messages, of each topic alike: bytes, times, or another message's content."""
    messages = [list(message) for message in recorded_run.messages(base())]
    topics = sorted({message[0] for message in messages})

    def change(message):
        at = data.draw(st.integers(0, 2**63 - 1))
        other = data.draw(st.sampled_from(messages))[3]
        raw = corrupted(
            data, data.draw(st.sampled_from((message[3], message[3], other)))
        )
        return [*message[:2], data.draw(st.sampled_from((message[2], at))), raw]

    topic = data.draw(st.sampled_from(topics))
    chosen = [message for message in messages if message[0] == topic]
    others = [message for message in messages if message[0] != topic]
    with folder() as bag:
        bag.rmdir()
        recorded_run.write(bag, others + disordered(data, chosen, change))
        with bounded():
            read(bag, way)


@functools.cache
def eventful():
    """Return messages of a rig that went through every kind of event."""
    from test_replay_events import eventful as made

    rig = made()
    rig.publish_events()
    return rig.entries


JSON = st.recursive(
    st.one_of(
        st.none(),
        st.booleans(),
        st.sampled_from((-1, 0, 1, 2**31, 2**53, 2**63 - 1, 2**63, -(2**70), 10**300)),
        st.sampled_from((0.5, -1.0, 1e308, 5e-324, float('nan'), float('inf'))),
        st.sampled_from(
            ('', 'joint1', 'blf_dsc', 'failed', 'stop', 'dance', 'x' * 300)
        ),
        st.text(max_size=8),
    ),
    lambda inner: st.one_of(
        st.lists(inner, max_size=4),
        st.dictionaries(st.text(max_size=8), inner, max_size=3),
    ),
    max_leaves=8,
)


def restructured(data, value):
    """Return JSON data of which one part, at any depth, is replaced, removed, added or repeated."""
    is_nested = (
        isinstance(value, (dict, list)) and value and data.draw(st.integers(0, 3))
    )
    if not is_nested:
        return data.draw(JSON)
    action = data.draw(st.sampled_from(('within', 'within', 'within', 'remove', 'add')))
    if isinstance(value, dict):
        return restructured_object(data, value, action)
    at = data.draw(st.integers(0, len(value) - 1))
    within = {
        'within': lambda: [restructured(data, value[at])],
        'remove': list,
        'add': lambda: [value[at]] * data.draw(st.integers(2, 50)),
    }
    return [*value[:at], *within[action](), *value[at + 1 :]]


def restructured_object(data, value, action):
    key = data.draw(st.sampled_from(sorted(value)))
    if action == 'add':
        return value | {data.draw(st.sampled_from((*value, 'x'))): data.draw(JSON)}
    rest = {name: each for name, each in value.items() if name != key}
    if action == 'remove':
        return rest
    return rest | {key: restructured(data, value[key])}


@fuzzed
@given(data=st.data(), way=WAYS)
def test_structure_of_the_journal_is_survived(data, way):
    """Events with other fields and values, which are valid JSON.

    Removed, repeated, in disorder.
    """
    journal, text = JOURNAL.resolved, typestore().types[JOURNAL.type]
    entries = [list(entry) for entry in eventful()]
    events = [entry for entry in entries if entry[0] == journal]
    for _ in range(data.draw(st.integers(1, 3))):
        entry = data.draw(st.sampled_from(events))
        message = typestore().deserialize_cdr(entry[3], JOURNAL.type)
        changed = json.dumps(restructured(data, json.loads(message.data)))
        entry[3] = bytes(typestore().serialize_cdr(text(data=changed), JOURNAL.type))
    if data.draw(st.integers(0, 4)) == 0:
        at = data.draw(st.integers(0, len(entries) - 1))
        entries.insert(at, data.draw(st.sampled_from(events)))
    with folder() as bag:
        bag.rmdir()
        recorded_run.write(bag, entries)
        with bounded():
            read(bag, way)


# Parameter files and URDFs.


@fuzzed
@given(
    data=st.data(), preset=st.sampled_from(('recommended', 'noisy', 'payload', 'panda'))
)
def test_parameters_are_survived(data, preset):
    """Parameter files: other values; lines repeated, removed or extended."""
    text = (blf.share_folder() / 'config' / f'{preset}.yaml').read_text()
    with folder() as inside:
        path = inside / 'given.yaml'
        path.write_bytes(damaged(data, text))
        with bounded(), contextlib.suppress(blf.BlfDscError):
            blf.load_loop(path)


NUMBERS_OF_XML = st.one_of(
    st.sampled_from(
        ('', 'nan', 'inf', '-1', '0', '1e308', '1e-320', '0 0 0', '1 0', 'x', '1_0')
    ),
    st.lists(st.floats(), min_size=1, max_size=4).map(lambda x: ' '.join(map(str, x))),
    st.text(max_size=8),
)


XML = (
    '<!DOCTYPE r [<!ENTITY a "aa"><!ENTITY b "&a;&a;">]>',
    f'{"<a>" * 20_000}{"</a>" * 20_000}',
    ''.join(f'<link name="x{k}"/>' for k in range(400))
    + ''.join(
        f'<joint name="y{k}" type="fixed"><parent link="x{k}"/><child link="x{k + 1}"/></joint>'
        for k in range(399)
    ),
)


@fuzzed
@given(data=st.data(), arm=st.sampled_from(('panda', 'ur5e')))
def test_urdfs_are_survived(data, arm):
    """URDFs: other attributes, also within links and joints.

    Those removed or repeated.
    """
    root = ET.fromstring((blf.share_folder() / 'config' / f'{arm}.urdf').read_text())  # noqa: S314 - ours
    values = sorted(
        {value for element in root.iter() for value in element.attrib.values()}
    )

    def change(element):
        within = data.draw(
            st.sampled_from([each for each in element.iter() if each.attrib])
        )
        key = data.draw(st.sampled_from(sorted(within.attrib)))
        within.set(key, data.draw(NUMBERS_OF_XML | st.sampled_from(values)))
        return element

    root[:] = disordered(data, root, change)
    text = ET.tostring(root, encoding='unicode')
    if data.draw(st.integers(0, 9)) == 0:
        at = data.draw(st.integers(0, len(text)))
        text = (
            text[:at]
            + data.draw(st.one_of(st.text(max_size=9), st.sampled_from(XML)))
            + text[at:]
        )
    with folder() as inside:
        path = inside / 'arm.urdf'
        path.write_bytes(text.encode('utf-8', 'surrogatepass'))
        given_file = inside / 'given.yaml'
        given_file.write_text(
            f'/**:\n  ros__parameters:\n    robot: {{urdf: {path}, lag: 0.005}}\n'
            '/**/blf_dsc_controller:\n  ros__parameters:\n'
            f'    barrier: {{bound: {[0.005] * (7 if arm == "panda" else 6)}}}\n'
        )
        with bounded():
            with contextlib.suppress(blf.BlfDscError):
                blf.load_loop(given_file)
            command('identify', base(), '--urdf', path, '--out', inside / 'out.urdf')


def test_loop_survives_a_short_soak():
    """The script checks by itself: the bound outside of faults, memory and handles."""
    script = Path(__file__).with_name('soak.py')
    run = subprocess.run(
        [sys.executable, str(script), '--minutes', '0.3', '--seed', '2'],
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stderr[-3000:]
    assert 'largest error against the bound' in run.stderr
