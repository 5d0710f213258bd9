# SPDX-License-Identifier: Apache-2.0
"""The site of the documentation: `make docs`, plain `sphinx-build doc out/docs`, or rosdoc2."""

import os
import re
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.logging import getLogger
from sphinx.writers.html5 import HTML5Translator

try:
    import ziamath
except ImportError:  # as where ROS runs rosdoc2
    ziamath = None

# rosdoc2 runs a conf.py of its own, in a copy of doc/, which executes this one by its
# path.
HERE = Path(__file__).resolve()
executed = re.search(r'exec\(open\("(.+)"\)', HERE.read_text(encoding='utf-8'))
ROOT = (Path(executed[1]) if executed else HERE).parents[1]
for shown in ('CHANGELOG.rst', 'benchmark', 'config'):  # by the pages
    if not (HERE.parents[1] / shown).exists():
        (HERE.parents[1] / shown).symlink_to(ROOT / shown)
sys.path.insert(0, str(ROOT))  # the docstrings of this checkout

from blf_dsc_controller import __version__  # noqa: E402

project = 'blf_dsc_controller'
author = 'The blf_dsc_controller contributors'
copyright = author  # noqa: A001 - Sphinx's name
release = version = __version__

extensions = ['myst_parser', 'sphinx.ext.autodoc', 'sphinx.ext.napoleon']
# rosdoc2's
exclude_patterns = ['user_docs*', 'standard*', '__*', 'modules.rst', f'{project}*']
myst_enable_extensions = ['dollarmath', 'tasklist']
myst_fence_as_directive = ['math']  # as GitHub writes equations
myst_heading_anchors = 4

highlight_language = 'none'  # of indented blocks
default_role = 'code'  # docstrings write `name`
autodoc_member_order = 'bysource'
autodoc_type_aliases = {name: name for name in ('Array', 'Floats', 'Stamps')}
autodoc_typehints_format = 'short'
python_use_unqualified_type_names = True
nitpicky = True
# Types of other packages, and those of the package that the page on Python does not
# show.
nitpick_ignore_regex = [('py:.*', '.*')]

html_theme = 'furo'
if shown := os.environ.get('SITE_VERSION'):  # in a folder beside those of others
    others = '<a href="../index.html">Other versions</a>'
    html_theme_options = {'announcement': f'Version {shown}. {others}'}
html_title = f'BLF-DSC {release}'
html_show_copyright = False
# Drawn when the site is made: no script, no font, no request, in any browser.
html_math_renderer = 'drawn' if ziamath else 'mathjax'
if ziamath:
    ziamath.config.svg2 = False
    ziamath.config.precision = 2
html_static_path = ['_static']
html_css_files = ['site.css']
# An excerpt would be fetched, which browsers refuse for files on disk: the list of
# results would end after the first.
html_show_search_summary = False


def draw(translator: HTML5Translator, node: nodes.math | nodes.math_block) -> None:
    """Write an equation as SVG; LaTeX that is not understood is a warning of the build."""
    inline = isinstance(node, nodes.math)
    size = 16.0  # of a letter, to which the text's size is 1 em
    equation = ziamath.Latex(
        node.astext(), size=size, color='currentColor', inline=inline
    )
    if '\\' in equation.mathmlstr():
        getLogger(__name__).warning('unknown LaTeX: %s', node.astext(), location=node)
    drawing = equation.svgxml()
    for side in ('width', 'height'):
        drawing.set(side, f'{float(drawing.get(side, 0)) / size:.2f}em')
    drawing.set('style', f'vertical-align: {equation.getyofst() / size:.2f}em')
    drawing.set('role', 'img')
    drawing.set('aria-label', node.astext())
    tag = 'span' if inline else 'div'
    svg = ET.tostring(drawing, encoding='unicode')
    translator.body.append(f'<{tag} class="equation">{svg}</{tag}>')
    raise nodes.SkipNode


def escape(*given: list[str]) -> None:
    """Take |x| in a docstring for the size of x, not for a substitution."""
    lines = given[-1]
    lines[:] = [line.replace('|', '\\|') for line in lines]


def setup(app: Sphinx) -> None:
    """Tell Sphinx of the two."""
    app.connect('autodoc-process-docstring', escape)
    app.add_html_math_renderer('drawn', (draw, None), (draw, None))
