# SPDX-License-Identifier: Apache-2.0
"""Setup for pip, colcon and ament: setup.cfg, with what package.xml and the README say."""

import re
import xml.etree.ElementTree as ET
from pathlib import Path

from setuptools import setup

# colcon --symlink-install runs a link to this file
HERE = Path(__file__).resolve().parent
MANIFEST = ET.parse(HERE / 'package.xml').getroot()  # noqa: S314 - our own file
(MAINTAINER,) = MANIFEST.findall('maintainer')
URLS = {url.get('type', 'website'): url.text for url in MANIFEST.findall('url')}


def readme() -> str:
    """Return README.md as PyPI can show it: links and pictures lead to the repository, if known."""
    text = (HERE / 'README.md').read_text(encoding='utf-8')
    if 'repository' not in URLS:
        return text
    for link, place in ((r'(!\[[^]]*\]\()', 'raw'), (r'((?<!!)\[[^]]*\]\()', 'blob')):
        address = rf'\1{URLS["repository"]}/{place}/{MANIFEST.findtext("version")}/'
        text = re.sub(rf'{link}(?![a-z]+://|#)', address, text)
    return text


setup(
    long_description=readme(),
    author=MAINTAINER.text,
    maintainer=MAINTAINER.text,
    maintainer_email=MAINTAINER.get('email'),
    project_urls=URLS,
    python_requires='>=3.10',  # colcon cannot read it from setup.cfg
)
