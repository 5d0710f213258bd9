# SPDX-License-Identifier: Apache-2.0
"""Untrusted files: their place, their limits, and parameter files as ROS 2 reads.

Data files of this package and of others are found with or without a sourced ROS. YAML
is limited in size and nesting, and has no aliases: a few lines of these can expand to a
billion entries, and deeply nested brackets exceed the recursion limit of the
interpreter.

In a parameter file node names nest or are joined by `/`; `*` matches one part of a
name, `**` any number of parts. If several sections match a node, the last one wins,
even if another is more specific. The types of unquoted words differ from those of YAML
libraries: `1e-5` is a number and `1_000` a string for ROS, the other way round for
PyYAML; `yes` is a bool, `010` is eight, `null` a string.
"""

from __future__ import annotations

import difflib
import functools
import importlib.util
import itertools
import math
import re
import stat
import sys
import sysconfig
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, cast

import yaml

from blf_dsc_controller.errors import BlfDscError, ConfigurationError

_TRUE = ('Y', 'y', 'yes', 'Yes', 'YES', 'true', 'True', 'TRUE', 'on', 'On', 'ON')
_FALSE = ('N', 'n', 'no', 'No', 'NO', 'false', 'False', 'FALSE', 'off', 'Off', 'OFF')
_INTEGER = re.compile(
    r'[+-]?(?:0[xX](?P<hex>[0-9a-fA-F]+)|(?P<octal>0[0-7]*)|[1-9][0-9]{0,18})'
)
_DECIMAL = re.compile(r'[+-]?(?P<digits>[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?')
_SPECIAL = re.compile(
    r'[+-]?(?i:inf|infinity|nan)|[+-]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)'
)
_COMMA = re.compile(r'[+-]?(?:0,[0-9]*[1-9]|[0-9]+,0[0-9])[0-9]*')  # 0,35 or 1,05
DECIMAL_POINT = 'a comma separates entries; if 0,035 is to be one number, write 0.035'

_MARK = 'ros__parameters'
_PART = re.compile(r'\*|\*\*|[A-Za-z_][A-Za-z0-9_]*')
_PACKAGE = 'blf_dsc_controller'
_PRESET = 'config/recommended.yaml'
_ABOVE = Path(__file__).resolve().parents[2:]  # the source tree, or below the prefix
_LARGEST = 1 << 24  # bytes of a parameter file, a URDF or a metadata.yaml
_MOST_NODES = 50_000
_DEEPEST = 50
_REMEDIES = (  # of problems of YAML that contain these words
    ('another document', 'leave out the line ---'),
    (
        "found '<block mapping start>'",
        'begin this line in the column of the other lines of its group',
    ),
    (
        'mapping values',
        'the line before lacks its colon, or this one is indented too far or has two',
    ),
    ("expected ':'", 'the line before has to be NAME: VALUE, with a colon and a space'),
    ("expected ',' or", 'a bracket before is not closed'),
    ('unexpected end of stream', 'a quote before is not closed'),
    ('that cannot start any token', 'write the text in quotes'),
    ('escape', "write the text in single quotes, as in 'C:\\arm.urdf'"),
)


class Entry(NamedTuple):
    """A value with its line, and the file of that if it is not the one that is read."""

    value: object
    line: int
    file: str = ''

    @property
    def place(self) -> str:
        """Where the value was written, for messages."""
        return f'line {self.line} of {self.file}' if self.file else f'line {self.line}'


class Section(NamedTuple):
    """The parameters under one `ros__parameters`, for nodes that match `pattern`."""

    pattern: str
    line: int
    entries: dict[str, Entry]

    @property
    def is_wildcard(self) -> bool:
        """Whether the section can match nodes with different names."""
        return '*' in self.pattern.rsplit('/', 1)[-1]

    def matches(self, node: str) -> bool:
        """Whether the section applies to the node with this fully qualified name."""
        expression = self.pattern.replace('/**', r'(?:/\w+)#').replace('/*', r'/\w+')
        return re.fullmatch(expression.replace('#', '*'), node) is not None


@functools.lru_cache(maxsize=16)  # a study loads the same presets hundreds of times
def parse(text: str) -> tuple[Section, ...]:
    """Read the sections of a parameter file, in order.

    Raises ConfigurationError, with the line, if the text is not YAML or not a parameter
    file.
    """
    try:
        root = _Composer(text).get_single_node()
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = f'line {mark.line + 1}: ' if mark else ''
        # of `_Limited`
        kind = '' if type(error) is yaml.MarkedYAMLError else 'not valid YAML: '
        problem = f'{line}{kind}{error.problem}{_remedy(text, error)}'
        raise ConfigurationError([problem]) from error
    except yaml.YAMLError as error:
        raise ConfigurationError([f'not valid YAML: {error}']) from error
    if root is None:
        raise ConfigurationError(
            [f'line 1: the file is empty: expected node names with {_MARK}']
        )
    sections: dict[tuple[str, ...], Section] = {}
    for names, node in _leaves(root, ()):
        if _MARK not in names:
            raise _error(node, _of_xml(text) or _outside(names))
        at = names.index(_MARK)
        pattern = f'/{"/".join(names[:at]).removeprefix("/")}'
        name = '.'.join(names[at + 1 :])
        if not all(_PART.fullmatch(part) for part in pattern.split('/')[1:]):
            raise _error(node if at else root, _misnamed(pattern))
        entries = sections.setdefault(
            names[:at], Section(pattern, _line(node), {})
        ).entries
        if name in entries:
            raise _repeated(node, name, entries[name].line)
        if name:
            entries[name] = Entry(_value(node, name), _line(node))
        elif not isinstance(node, yaml.MappingNode):
            raise _error(
                node, f'{_MARK} of {pattern} has no parameters: {_no_names(node)}'
            )
    return tuple(sections.values())


def _of_xml(text: str) -> str:
    """Return what to do about XML in the place of a parameter file; empty: it is none."""
    if not text.lstrip().startswith('<'):
        return ''
    return 'it is XML: give a parameter file that names it as robot.urdf'


def _remedy(text: str, error: yaml.MarkedYAMLError) -> str:
    """Return what to do about frequent mistakes in YAML."""
    if xml := _of_xml(text):
        return f'; {xml}'
    mark = error.problem_mark
    if mark is not None and mark.buffer and mark.buffer[mark.pointer :][:1] == '\t':
        return ': indent with spaces, not with tabs'
    return next(
        (f': {what}' for of, what in _REMEDIES if of in (error.problem or '')), ''
    )


def _misnamed(pattern: str) -> str:
    if pattern == '/':
        return f'write /**: above {_MARK}, and indent all below it'
    return f'{pattern} is not a valid node name: write one like /**/{_PACKAGE}'


def _no_names(node: yaml.Node) -> str:
    """Return how to write what stands in the place of parameters by name."""
    if not isinstance(node, yaml.ScalarNode):
        return 'write NAME: VALUE, without dashes or brackets'
    if not node.value:
        return 'indent them below it, with spaces'
    return f'write NAME: VALUE, with a space behind the colon, not {node.value!a}'


def _outside(names: tuple[str, ...]) -> str:
    """Return what is wrong with a value outside of the mark, below these names."""
    if not names:
        return (
            f'expected node names or {_MARK} at the top, such as '
            f'{{/**: {{{_MARK}: {{sample_time: 0.001}}}}}}'
        )
    problem = f'{names[-1]} has a value, but is outside of {_MARK}'
    if any(not character.isascii() for character in ''.join(names)):
        return f'{problem}: {names[-1]!a} has other letters than those of ASCII, perhaps spaces'
    close = difflib.get_close_matches(_MARK, names, n=1, cutoff=0.8)
    if close:
        return f'{problem}: {close[0]} has to be {_MARK}'
    return f'{problem}: write {_MARK}: below the name of the node, and this below it'


def parse_scalar(word: str) -> bool | int | float | str:
    """Return the value of an unquoted word, as get_value() of ROS's parser does.

    Hexadecimal fractions, such as 0x1p3, are left as text.
    """
    if word in _TRUE or word in _FALSE:
        return word in _TRUE
    if match := _INTEGER.fullmatch(word):
        value = int(word, 16 if match['hex'] else 8 if match['octal'] else 10)
        if -(2**63) <= value < 2**63:
            return value
    if _SPECIAL.fullmatch(word):
        return float(word.replace('.', ''))
    if match := _DECIMAL.fullmatch(word):
        number = float(word)
        underflow = (
            abs(number) < sys.float_info.min and match['digits'].strip('0.') != ''
        )
        if math.isfinite(number) and not underflow:
            return number
    return word


def _leaves(
    node: yaml.Node, names: tuple[str, ...]
) -> Iterator[tuple[tuple[str, ...], yaml.Node]]:
    """Yield what stands below nested names: values, lists, and empty mappings."""
    if not isinstance(node, yaml.MappingNode) or not node.value:
        yield names, node
        return
    lines: dict[str, int] = {}
    for key, value in node.value:
        if not isinstance(key, yaml.ScalarNode) or not key.value:
            raise _error(key, 'expected a name before the colon')
        if key.value in lines:
            raise _repeated(key, key.value, lines[key.value])
        lines[key.value] = _line(key)
        if _MARK in lines and len(lines) > 1:
            raise _error(value, f'{" and ".join(lines)} cannot be next to each other')
        yield from _leaves(value, (*names, key.value))


def _value(node: yaml.Node, name: str) -> object:
    if isinstance(node, yaml.MappingNode):
        raise _error(node, f'{name} has no parameters')
    if not isinstance(node, yaml.SequenceNode):
        return _scalar(node, name)
    values = [_scalar(entry, name) for entry in node.value]
    if len({type(value) for value in values}) > 1:
        words = [value for value in values if isinstance(value, str)]
        alike = f'{words[0]!a} is text' if words else '1.0, not 1'
        if _has_decimal_comma([entry.value for entry in node.value]):
            alike += f'; {DECIMAL_POINT}'
        raise _error(
            node,
            f'{name} mixes types, which ROS rejects: write all entries alike ({alike})',
        )
    return values


def _has_decimal_comma(words: Sequence[str]) -> bool:
    """Whether two words may be a number that was written with a comma, such as 0 and 035."""
    return any(_COMMA.fullmatch(f'{a},{b}') for a, b in itertools.pairwise(words))


def _scalar(node: yaml.Node, name: str) -> object:
    if not isinstance(node, yaml.ScalarNode):
        raise _error(
            node,
            f'{name} has a list in a list, which ROS rejects: write one list, row after row',
        )
    if node.style in ('"', "'") or node.tag == 'tag:yaml.org,2002:str':
        return node.value
    if not node.value:
        hint = f': {DECIMAL_POINT}' if name.rpartition('.')[2].isdigit() else ''
        if ':' in name:
            hint = ': write a space behind the colon'
        raise _error(node, f'{name} has no value{hint}')
    return parse_scalar(node.value)


def _line(node: Any) -> int:
    return cast('int', node.start_mark.line) + 1


def _error(node: yaml.Node, problem: str) -> ConfigurationError:
    return ConfigurationError([f'line {_line(node)}: {problem}'])


def _repeated(node: yaml.Node, name: str, first: int) -> ConfigurationError:
    return _error(node, f'{name} is repeated, first given on line {first}')


class _Limited(yaml.composer.Composer):
    """Limits on the size and nesting of YAML, and no aliases."""

    peek_event: Callable[[], Any]  # of the parser
    _nodes = _depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        event: Any = self.peek_event()
        self._nodes += 1
        self._depth += 1
        problem = ''
        if isinstance(event, yaml.AliasEvent):
            problem = (
                f'ROS does not support the alias *{event.anchor}: write out its value'
            )
        elif self._depth > _DEEPEST:
            problem = f'nested more than {_DEEPEST} levels deep'
        elif self._nodes > _MOST_NODES:
            problem = (
                f'more than {_MOST_NODES} entries: leave out what does not belong here'
            )
        if problem:
            raise yaml.MarkedYAMLError(problem=problem, problem_mark=event.start_mark)
        node = super().compose_node(parent, index)
        self._depth -= 1
        return node


class _Composer(_Limited, yaml.BaseLoader):
    """Keeps each word as written."""

    DEFAULT_SCALAR_TAG = '?'  # type: ignore[misc] # unlike an explicit !!str


class _Loader(_Limited, yaml.SafeLoader):
    """Makes plain data."""


def load_yaml(text: str) -> Any:
    """Return the plain data of a YAML text.

    Raises yaml.YAMLError if damaged or unreasonable.
    """
    return yaml.load(text, Loader=_Loader)  # noqa: S506 - a safe loader


def share_folder() -> Path:
    """Return the folder that holds `config/` and `launch/`.

    That is the source tree, as in an editable install, or `share/blf_dsc_controller` of
    the prefix where colcon or pip installed this file.

    Raises BlfDscError if there is neither.
    """
    for place in (
        place for above in _ABOVE for place in (above, above / 'share' / _PACKAGE)
    ):
        if (place / _PRESET).is_file():
            return place
    raise BlfDscError(
        f'{_PRESET} was not found above {_ABOVE[0]}, nor in a share/{_PACKAGE} there: install the '
        'package again'
    )


def resolve(url: str) -> Path:
    """Return the path of a file, or of a resource as `package://name/path`.

    A path that does not exist is looked up in `config/` of this package. A package is
    one of ROS, or a Python package that pip installed: its folder in `share/` or its
    own. Raises BlfDscError if there is no such folder or package.
    """
    if not url.startswith('package://'):
        url = url.removeprefix('file://')
        path = Path(url).expanduser()
        own = share_folder() / 'config' / url
        return path if path.is_file() or not own.is_file() else own
    package, _, rest = url.removeprefix('package://').partition('/')
    if package == _PACKAGE:
        return share_folder() / rest
    try:
        from ament_index_python.packages import get_package_share_directory

        return Path(get_package_share_directory(package), rest)
    except (ImportError, LookupError, OSError) as error:
        for place in _of_python(package):
            if (place / rest).exists():
                return place / rest
        raise BlfDscError(
            f'package {package!r} was not found with {rest!r} in it: source its workspace, '
            'install it with pip, or give a path'
        ) from error


def _of_python(package: str) -> Iterator[Path]:
    """Yield the folders that can hold the data of a package.

    pip has installed it; it is not imported.
    """
    yield Path(sysconfig.get_path('data')) / 'share' / package
    spec = importlib.util.find_spec(package) if package.isidentifier() else None
    if spec is not None:
        yield from map(Path, spec.submodule_search_locations or ())


def places_of(url: str) -> str:
    """Return where `resolve` has looked for a file that does not exist, in words."""
    if url.startswith('package://'):
        return str(resolve(url))
    path = Path(url).expanduser()
    if path.is_absolute():
        return str(path)
    return f'{path.absolute()}, nor {share_folder() / "config" / url}'


def read_text(path: Path) -> str:
    """Return the text of a file.

    OSError if it is not regular, too large, or not UTF-8.
    """
    state = path.stat()
    if not stat.S_ISREG(state.st_mode):
        raise OSError(f'{path} is not a regular file: give a file')
    if state.st_size > _LARGEST:
        raise OSError(
            f'{path} has {state.st_size} bytes; expected text of at most {_LARGEST}'
        )
    try:
        return path.read_text(encoding='utf-8-sig')  # some editors mark their files
    except UnicodeDecodeError as error:
        raise OSError(
            f'{path} is no text in UTF-8 (byte {error.start}): save it as UTF-8'
        ) from error
